"""Where scene and panels lie in windows of every size, and what a page without its server shows.

Viser docks panels at the sides of the scene and covers the scene of a phone by its panel.  This
style sheet puts them below the scene in a window that is higher than wide, and makes them narrower
in a small one; a window with room for both is left to viser, where panels can be moved.
"""

from __future__ import annotations

PANEL_PX, LEFT_PX, LEFT_OF_SEVERAL_PX = 330, 400, 310
# Widths of windows up to which viser shows its panel as on a phone, and which are small, em and px.
PHONE, SMALL = "36em", "1150px"
# Width of a panel beside the scene of a small window, px, and share of the scene above panels, %.
SMALL_PANEL_PX, SCENE_PERCENT, PHONE_SCENE_PERCENT = 285, 52, 42
# Whole lines of health: as many times size and height of one (panels.SMALL), em.
HEALTH_EM = 8 * 0.85 * 1.35
# A page hears a beat each BEAT_S; one that has heard none for SILENT_S has lost its server.
BEAT_S, SILENT_S = 1.0, 5.0
LOST = "connection lost"

# Plots are canvases, too.
_SCENE = "[data-dock-root] > div:has(canvas[data-engine])"
_REGION = "[data-dock-region={side}]"
_COLUMN = "[data-dock-region={side}] > div > div:has([data-dock-column])"
# In small windows panels have their place, and the gel all the rest: what would move panels or
# stand before the gel is hidden.
_HANDLES = "[data-dock-region-handle], [data-dock-region-resize]"
_NOTES = ".mantine-Notifications-root"
_SHADOW = "[data-dock-root] > div:not(:has(*))"
_SHEET = "#root .mantine-Paper-root:has(> div > .mantine-ScrollArea-root)"


def _regions(rules: str) -> str:
    """Rules of the left and the right region; {side} is the side."""
    return "".join(rules.replace("{side}", side) for side in ("left", "right"))


_BESIDE = (
    _regions(f"{_REGION}, {_COLUMN} {{ width: {SMALL_PANEL_PX}px !important }}")
    + f"{_SCENE} {{ inset: 0 {SMALL_PANEL_PX}px !important }}"
)
_BELOW = (
    _regions(
        f"{_REGION} {{ width: 50% !important; top: {SCENE_PERCENT}% !important }}"
        f"{_COLUMN} {{ width: 100% !important }}"
    )
    + f"{_SCENE} {{ inset: 0 0 {100 - SCENE_PERCENT}% 0 !important }}"
)
_ON_A_PHONE = (
    f"{_SCENE} {{ inset: 0 0 {100 - PHONE_SCENE_PERCENT}% 0 !important }}"
    f"{_SHEET} {{ width: 100% !important; max-height: {100 - PHONE_SCENE_PERCENT}% !important }}"
    f"{_SHEET} .mantine-ScrollArea-content > div {{ width: 100% !important }}"
    f"{_SHEET} .mantine-ScrollArea-viewport {{ overflow-x: hidden !important }}"
    # Images and plots come before the controls: they are one line until they are opened.
    f"{_SHEET} .mantine-ScrollArea-content > div > div:has(> div > .mantine-Tabs-root)"
    " { display: flex; flex-direction: column }"
    f"{_SHEET} .mantine-ScrollArea-content > div > div > div:has(> .mantine-Tabs-root)"
    " { order: -1 }"
)
STYLE = f"""<style>
@media (max-width: {SMALL}) {{ {_NOTES} {{ display: none !important }} }}
@media (min-width: {PHONE}) and (max-width: {SMALL}) {{
  {_HANDLES}, {_SHADOW} {{ display: none !important }}
}}
@media (min-width: {PHONE}) and (max-width: {SMALL}) and (min-aspect-ratio: 1/1) {{ {_BESIDE} }}
@media (min-width: {PHONE}) and (max-width: {SMALL}) and (max-aspect-ratio: 1/1) {{ {_BELOW} }}
@media (max-width: {PHONE}) {{ {_ON_A_PHONE} }}
.cmp-health {{ height: {HEALTH_EM:.2f}em; overflow-y: auto }}
.cmp-lost {{ animation: cmp-show 0s {SILENT_S}s forwards; visibility: hidden; position: absolute;
  left: 0; right: 0; bottom: 0; height: {HEALTH_EM + 1:.2f}em; padding: 0.5em; font-weight: bold;
  color: #d00000; background: var(--mantine-color-body) }}
@keyframes cmp-show {{ to {{ visibility: visible }} }}
</style>"""


def health_box(lines: str) -> str:
    """HTML of the list of health in a box of fixed height."""
    return f'<div class="cmp-health">{lines}</div>'


def beat_html(beat: int) -> str:
    """HTML to stand below the health box: covers it by LOST where no other beat comes in time."""
    return (
        f'<div data-beat="{beat}" style="position: relative"><div class="cmp-lost" role="alert">'
        f"&#10007; {LOST}: the page looks for its server</div></div>"
    )
