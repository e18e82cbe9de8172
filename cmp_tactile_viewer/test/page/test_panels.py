"""What stands in the list of health."""

from __future__ import annotations

from cmp_tactile_viewer.page.panels import health_html
from cmp_tactile_viewer.snapshot import HealthLine, Level


def test_the_worst_comes_first_with_a_sign_of_its_own():
    lines = [HealthLine(Level.OK, "a", "x"), HealthLine(Level.ERROR, "b", "y")]
    text = health_html(lines)
    assert text.index("y") < text.index("x")
    assert "&#10007; b" in text
    assert "&#10003; a" in text


def test_a_text_from_a_topic_is_never_html():
    text = health_html([HealthLine(Level.WARN, "<b>", "<img src=x onerror=alert(1)>")])
    assert "<img" not in text
    assert "&lt;b&gt;" in text
