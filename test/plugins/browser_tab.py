"""A tab of a real browser that shows a page of the viewer."""

from collections.abc import Callable
from typing import Any

import numpy as np
from waiting import wait_until

SIZE: Any = {"width": 1200, "height": 800}
TIMEOUT_MS = 20_000
# three.js shows its scenes to developers' tools: here, to the tests.
SHOW_SCENES = """
window.scenes = [];
window.__THREE_DEVTOOLS__ = new EventTarget();
window.__THREE_DEVTOOLS__.addEventListener('observe', event => {
  const seen = event.detail;
  if (seen.isWebGLRenderer) {
    // Without a graphics card, pictures of the whole window take most of the time.
    seen.setPixelRatio(0.2);
    seen.setPixelRatio = () => {};
  }
  if (!seen.isScene) return;
  window.scenes.push(seen);
  seen.onBeforeRender = (renderer, scene, camera) => {
    if (camera.isPerspectiveCamera) window.camera = camera;
  };
});
// Meshes of a gel that are seen.
window.gels = () => {
  const found = [];
  const seen = object => !object || (object.visible && seen(object.parent));
  for (const scene of window.scenes) scene.traverse(object => {
    const at = object.isMesh && object.geometry.index && object.geometry.attributes.position;
    if (!at || object.isInstancedMesh || object.geometry.index.count < 30 || !seen(object)) return;
    if (object.geometry.type !== 'BufferGeometry' || object.material.wireframe) return;
    found.push(object);
  });
  return found;
};
"""
# Of all gels: number of points, and highest z, mm.
MESHES = """() => {
  let points = 0, highest = -1e9;
  for (const {geometry} of window.gels()) {
    const at = geometry.attributes.position;
    points += at.count;
    for (let i = 0; i < at.count; i++) highest = Math.max(highest, at.getZ(i));
  }
  return [points, highest];
}"""
# Of all points of all gels: where they are in the window, px, and whether nothing covers them.
SEEN_POINTS = """() => {
  const points = [];
  for (const gel of window.camera ? window.gels() : []) {
    const at = gel.geometry.attributes.position, place = gel.position.clone();
    for (let i = 0; i < at.count; i++) {
      place.fromBufferAttribute(at, i).applyMatrix4(gel.matrixWorld).project(window.camera);
      const {x, y, z} = place, scene = document.querySelector('canvas[data-engine]');
      const {left, top, width, height} = scene.getBoundingClientRect();
      const px = [left + width * (1 + x) / 2, top + height * (1 - y) / 2];
      const onTop = z < 1 && document.elementFromPoint(...px);
      points.push([...px, onTop === scene ? 1 : 0]);
    }
  }
  return points;
}"""

PIXEL = """place => {
  const gel = window.gels()[0];
  if (!gel || !window.camera) return null;
  const {left, top, width, height} =
    document.querySelector('canvas[data-engine]').getBoundingClientRect();
  const {x, y} = window.camera.position.clone().fromArray(place)
    .applyMatrix4(gel.matrixWorld).project(window.camera);
  return [left + width * (1 + x) / 2, top + height * (1 - y) / 2];
}"""
ON_TOP = """element => {
  const {x, y, width, height} = element.getBoundingClientRect();
  return element.contains(document.elementFromPoint(x + width / 2, y + height / 2));
}"""


class Tab:
    """A tab of the browser, with what its console said and whom it asked."""

    def __init__(self, chromium: Any, page: Any, size: Any = None) -> None:
        self.tab = chromium.new_page(viewport=size or SIZE)
        self.tab.set_default_timeout(TIMEOUT_MS)
        self.console: list[str] = []
        self.requests: list[str] = []
        self.tab.on("console", self._said)
        self.tab.on("pageerror", lambda error: self.console.append(f"{error}: {error.stack}"))
        self.tab.on("request", lambda request: self.requests.append(request.url))
        self.tab.on("websocket", lambda socket: self.requests.append(socket.url))
        self.tab.add_init_script(SHOW_SCENES)
        self.tab.goto(page.url)

    def _said(self, message: Any) -> None:
        if message.type == "error":
            self.console.append(f"{message.text} ({message.location})")

    def meshes(self) -> tuple[int, float]:
        points, highest = self.tab.evaluate(MESHES)
        return points, highest

    def gel_points(self) -> Any:
        """Of each point of the gels: place in the window, px, and 1 if it is on top; (n, 3)."""
        return np.array(self.tab.evaluate(SEEN_POINTS)).reshape(-1, 3)

    def pixel(self, *place_mm: float) -> tuple[float, float]:
        """Where a place in the first gel's frame is in the window, px, once that is drawn."""
        places: list[tuple[float, float]] = []

        def found() -> bool:
            place = self.tab.evaluate(PIXEL, place_mm)
            places.extend([place] if place else [])
            return bool(places)

        self.wait(found, "the first gel")
        x, y = places[0]
        return x, y

    def is_on_top(self, text: str) -> bool:
        """Whether a text is seen, and nothing covers it."""
        return bool(self.tab.get_by_text(text).first.evaluate(ON_TOP))

    def sees(self, text: str) -> None:
        """Wait until a text is on the page."""
        self.tab.get_by_text(text).first.wait_for()

    def wait(self, condition: Callable[[], object], what: str) -> None:
        wait_until(condition, what, step=lambda: self.tab.wait_for_timeout(50))
