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
HEALTH_EM = 6.5
# A page that has heard nothing for so long has lost its server.  It hears something twice a second.
SILENT_S = 5.0
LOST = "connection lost"

# Plots are canvases, too.
_SCENE = "[data-dock-root] > div:has(canvas[data-engine])"
_REGION = "[data-dock-region={side}]"
_COLUMN = "[data-dock-region={side}] > div > div:has([data-dock-column])"
# In these windows panels have their place: what would move or resize them is hidden.
_HANDLES = "[data-dock-region-handle], [data-dock-region-resize]"
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
    # Images and plots come before the controls: they are one line until they are opened.
    f"{_SHEET} .mantine-ScrollArea-content > div > div:has(> div > .mantine-Tabs-root)"
    " { display: flex; flex-direction: column }"
    f"{_SHEET} .mantine-ScrollArea-content > div > div > div:has(> .mantine-Tabs-root)"
    " { order: -1 }"
)
STYLE = f"""<style>
@media (min-width: {PHONE}) and (max-width: {SMALL}) {{
  {_HANDLES}, {_SHADOW} {{ display: none !important }}
}}
@media (min-width: {PHONE}) and (max-width: {SMALL}) and (min-aspect-ratio: 1/1) {{ {_BESIDE} }}
@media (min-width: {PHONE}) and (max-width: {SMALL}) and (max-aspect-ratio: 1/1) {{ {_BELOW} }}
@media (max-width: {PHONE}) {{ {_ON_A_PHONE} }}
.cmp-health {{ height: {HEALTH_EM}em; overflow-y: auto; position: relative }}
.cmp-known {{ animation: cmp-hide 0s {SILENT_S}s forwards }}
.cmp-lost {{ animation: cmp-show 0s {SILENT_S}s forwards; visibility: hidden; position: absolute;
  inset: 0; color: #b00020; font-weight: bold }}
@keyframes cmp-hide {{ to {{ visibility: hidden }} }}
@keyframes cmp-show {{ to {{ visibility: visible }} }}
</style>"""


def health_box(lines: str, beat: int) -> str:
    """HTML of the list of health in a box of fixed height.

    beat: changes with each call; the browser shows LOST where no other has come for SILENT_S.
    """
    return (
        f'<div class="cmp-health" data-beat="{beat}"><div class="cmp-known">{lines}</div>'
        f'<div class="cmp-lost" role="alert">&#10007; {LOST}: the page is tried again and again'
        "</div></div>"
    )
