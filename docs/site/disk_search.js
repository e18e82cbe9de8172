// Browsers start no worker for a page that is read from a disk: search runs in a hidden frame there.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      const frame = document.createElement("iframe")
      frame.hidden = true
      document.documentElement.append(frame)
      this.scope = frame.contentWindow
      this.scope.importScripts = (...urls) =>
        urls.reduce((before, next) => before.then(() => this.load(next)), Promise.resolve())
      this.scope.postMessage = data => this.dispatch(this, data)
      this.ready = this.load(new URL(url, location).href)
    }
    load(url) {
      return new Promise((resolve, reject) => {
        const script = this.scope.document.createElement("script")
        Object.assign(script, { src: url, onload: resolve, onerror: reject })
        this.scope.document.documentElement.append(script)
      })
    }
    dispatch(target, data) {
      const event = new MessageEvent("message", { data })
      target.dispatchEvent(event)
    }
    postMessage(data) {
      this.ready.then(() => this.dispatch(this.scope, data))
    }
    set onmessage(listener) {
      this.addEventListener("message", listener)
    }
    terminate() {
      this.scope.frameElement.remove()
    }
  }
}
