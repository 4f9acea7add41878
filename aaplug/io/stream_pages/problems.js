// Tells on the page why nothing is drawn, where that is all a visitor would see.
const line = document.createElement("p");
line.style = "margin: 0; padding: 1em; font: 16px sans-serif";

function tell(problem) {
  line.textContent ||= problem;
  document.body.prepend(line);
}

addEventListener("error", ({ error, message, target }) => {
  if (target.tagName === "SCRIPT") tell(`${target.src || "The viewer's program"} cannot be read`);
  else if (message && !message.startsWith("ResizeObserver")) tell(`This page failed: ${error ?? message}`);
}, true);
addEventListener("unhandledrejection", ({ reason }) => tell(`This page failed: ${reason}`));
new PerformanceObserver((list) => { // of which some viewers say nothing
  const missing = list.getEntries().find(({ responseStatus }) => responseStatus === 404);
  if (missing) tell(`${missing.name} is not on the server`);
}).observe({ type: "resource", buffered: true });
if (location.protocol === "file:") {
  tell("A browser opens levels from a server only: run “python -m http.server” in this folder, and open http://localhost:8000.");
}
