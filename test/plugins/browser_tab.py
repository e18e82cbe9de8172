"""A tab of a real browser that shows a page of the viewer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from waiting import wait_until

SIZE: Any = {"width": 1200, "height": 800}
TIMEOUT_MS = 20_000
# three.js shows its scenes to developers' tools: here, to the tests.
SHOW_SCENES = """
window.scenes = [];
window.__THREE_DEVTOOLS__ = new EventTarget();
window.__THREE_DEVTOOLS__.addEventListener('observe', event => {
  if (event.detail.isScene) window.scenes.push(event.detail);
});
"""
# Of all meshes that are seen and have triangles: number of points, and highest z, mm.
MESHES = """() => {
  let points = 0, highest = -1e9;
  const seen = object => !object || (object.visible && seen(object.parent));
  for (const scene of window.scenes) scene.traverse(object => {
    const at = object.isMesh && object.geometry.index && object.geometry.attributes.position;
    if (!at || object.isInstancedMesh || object.geometry.index.count < 30 || !seen(object)) return;
    if (object.geometry.type !== 'BufferGeometry' || object.material.wireframe) return;
    points += at.count;
    for (let i = 0; i < at.count; i++) highest = Math.max(highest, at.getZ(i));
  });
  return [points, highest];
}"""


class Tab:
    """A tab of the browser, with what its console said and whom it asked."""

    def __init__(self, chromium: Any, page: Any) -> None:
        self.tab = chromium.new_page(viewport=SIZE)
        self.tab.set_default_timeout(TIMEOUT_MS)
        self.console: list[str] = []
        self.requests: list[str] = []
        self.tab.on("console", self._said)
        self.tab.on("pageerror", lambda error: self.console.append(str(error)))
        self.tab.on("request", lambda request: self.requests.append(request.url))
        self.tab.on("websocket", lambda socket: self.requests.append(socket.url))
        self.tab.add_init_script(SHOW_SCENES)
        self.tab.goto(page.url)

    def _said(self, message: Any) -> None:
        if message.type == "error":
            self.console.append(message.text)

    def meshes(self) -> tuple[int, float]:
        points, highest = self.tab.evaluate(MESHES)
        return points, highest

    def sees(self, text: str) -> None:
        """Wait until a text is on the page."""
        self.tab.get_by_text(text).first.wait_for()

    def wait(self, condition: Callable[[], object], what: str) -> None:
        wait_until(condition, what, step=lambda: self.tab.wait_for_timeout(50))
