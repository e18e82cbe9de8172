"""What the set-up does beside the build."""

import pytest

from cmp_tactile_setup.checkout import compiling_beside


@pytest.mark.parametrize("status", [0, 1])
def test_compiling_beside_the_build_may_fail(layout, capsys, status):
    layout.venv_python.parent.mkdir(parents=True)
    layout.venv_python.write_text(f'#!/bin/sh\necho "$@ $PYTHONPATH"\nexit {status}\n')
    layout.venv_python.chmod(0o755)
    with compiling_beside(layout, {"PYTHONPATH": "/opt/ros"}):
        built = True
    assert built
    sources = [f"{layout.root}/cmp_tactile_{name}" for name in ("processing", "simulation")]
    command, paths = (layout.logs / "compile.log").read_text().rsplit(" ", 1)
    prefix = layout.install / "cmp_tactile_processing"
    assert command == f"-m cmp_tactile_processing.prepare sample_rig --install {prefix}"
    assert paths.strip() == ":".join([*sources, "/opt/ros"])
    said = capsys.readouterr().out
    assert ("FAILED" in said) == ("the first start of the software will" in said) == bool(status)


def test_a_build_that_fails_ends_the_compiling(layout):
    layout.venv_python.parent.mkdir(parents=True)
    layout.venv_python.write_text("#!/bin/sh\nexec sleep 600\n")
    layout.venv_python.chmod(0o755)
    with pytest.raises(ValueError, match="no compiler"), compiling_beside(layout, {}):
        raise ValueError("no compiler")
