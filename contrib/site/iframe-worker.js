// Browsers start no worker for a page that was opened as a file, and the search of the site needs one. There this class takes
// its place: it runs the worker's script in a hidden frame.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      this.frame = document.createElement("iframe");
      this.frame.hidden = true;
      this.frame.answer = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
      this.frame.srcdoc =
        `<script>postMessage = (data) => frameElement.answer(data)</script><script src="${url}"></script>`;
      this.loaded = new Promise((done) => (this.frame.onload = done));
      document.body.append(this.frame);
    }

    postMessage(data) {
      this.loaded.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data })));
    }
  };
}
