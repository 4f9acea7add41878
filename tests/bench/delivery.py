"""The checkers of delivered formats: those of Khronos for glTF, and USD's own.

GLTF_VALIDATOR names the folder of the npm package gltf-validator.
"""

import json
import os
import subprocess
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from aaplug.io.scenes.usd import module

SCRIPT = """
const fs = require("fs"), path = require("path"), validator = require(process.argv[1]);
(async () => {
  for (const file of fs.readFileSync(0, "utf8").split("\\n").filter(Boolean)) {
    const beside = (uri) => Promise.resolve(new Uint8Array(fs.readFileSync(path.join(path.dirname(file), uri))));
    const report = await validator.validateBytes(
      new Uint8Array(fs.readFileSync(file)),
      { uri: path.basename(file), maxIssues: 0, externalResourceFunction: beside });
    for (const { code, message, severity, pointer } of report.issues.messages)
      console.log(JSON.stringify({ file, code, message, severity, pointer }));
  }
})();
"""
WARNING = 1  # severities: 0 errors, 1 warnings, 2 information, 3 hints
NAMES = "/attributes/KHR_gaussian_splatting:"  # of the ratified extension, which the validator does not know yet


def checked(files: Sequence[Path]) -> Counter[str]:
    """Errors and warnings of the Khronos validator, but for the names of the extension's attributes."""
    command = ["node", "-e", SCRIPT, os.environ["GLTF_VALIDATOR"]]
    text = "\n".join(str(file.resolve()) for file in files)
    run = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
    found = Counter[str]()
    for issue in map(json.loads, run.stdout.splitlines()):
        unknown = issue["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and NAMES in issue["pointer"]
        if issue["severity"] <= WARNING and not unknown:
            found[f"{issue['code']}: {issue['message']}"] += 1
    return found


def checked_by_usd(files: Sequence[Path]) -> Counter[str]:
    """What all of USD's validators find wrong."""
    Usd, Validation = module("Usd"), module("UsdValidation")
    context = Validation.ValidationContext(Validation.ValidationRegistry().GetOrLoadAllValidators())
    return Counter(e.GetMessage() for file in files for e in context.Validate(Usd.Stage.Open(str(file))))
