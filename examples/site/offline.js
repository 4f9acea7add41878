// A page that is opened from a folder may start no Worker: the window of a hidden iframe runs the search instead.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = Object.assign(document.createElement("iframe"), { hidden: true });
      frame.answer = data => this.dispatchEvent(new MessageEvent("message", { data }));
      frame.srcdoc = `<script>postMessage = data => frameElement.answer(data)</script>
        <script src="${String(new URL(url, location)).replaceAll("&", "&amp;")}"></script>`;
      this.scope = new Promise(ready => { frame.onload = () => ready(frame.contentWindow); });
      document.body.append(frame);
    }

    async postMessage(data) {
      (await this.scope).dispatchEvent(new MessageEvent("message", { data }));
    }
  };
}
