// Takes pictures of a scene in one viewer: node run.mjs JOB.json, as viewers.py writes it.
// Chromium draws on Mesa's llvmpipe, so that no graphics card is needed.  Paths under /node_modules/ and the page are
// served from this folder, /scene/ is the job's folder; the page loads `url` from there.
import { createReadStream, readFileSync, writeFileSync } from "node:fs";
import { createServer } from "node:http";
import { extname, join, normalize } from "node:path";
import { chromium } from "playwright-core";

const TYPES = { ".html": "text/html", ".mjs": "text/javascript", ".js": "text/javascript", ".wasm": "application/wasm" };
const job = JSON.parse(readFileSync(process.argv[2]));

function serve(request, response) {
  const path = normalize(decodeURIComponent(new URL(request.url, "http://host").pathname));
  const file = path.startsWith("/scene/") ? join(job.scene, path.slice(7)) : join(import.meta.dirname, path);
  createReadStream(file)
    .on("error", () => response.writeHead(404).end())
    .once("open", () => response.writeHead(200, { "content-type": TYPES[extname(file)] ?? "application/octet-stream" }))
    .pipe(response);
}

const server = createServer(serve);
await new Promise((listening) => server.listen(0, "127.0.0.1", listening));
const browser = await chromium.launch({
  executablePath: job.chromium,
  args: ["--no-sandbox", "--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist", "--enable-unsafe-swiftshader"],
  env: { ...process.env, LIBGL_ALWAYS_SOFTWARE: "1" },
});
try {
  const page = await browser.newPage({ viewport: { width: 900, height: 900 }, deviceScaleFactor: 1 });
  page.setDefaultTimeout(job.seconds * 1000);
  page.on("pageerror", (error) => console.error(`page: ${error.message}`));
  page.on("console", (note) => { if (["error", "warning"].includes(note.type()) && !/GPU stall/.test(note.text())) console.error(note.text().slice(0, 300), note.location().url); });
  await page.goto(`http://127.0.0.1:${server.address().port}/${job.page}.html`);
  await page.waitForFunction("window.ready === true");
  await page.evaluate(([url, options]) => window.load(url, options), [`/scene/${job.url}`, job.options]);
  for (const shot of job.shots) {
    const picture = await page.evaluate((view) => window.shot(view), shot);
    writeFileSync(shot.file, Buffer.from(picture.split(",")[1], "base64"));
  }
} finally {
  await browser.close();
  server.close();
}
