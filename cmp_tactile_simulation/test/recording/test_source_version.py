"""A recording made with other sources is another recording."""

from cmp_tactile_processing.cache.compiled import source_digest
from cmp_tactile_simulation.recording.run import job_of


def test_sources_below_count_and_nodes_do_not(tmp_path):
    for folder in ("force", "nodes"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "model.py").write_text("a = 1\n")
    before = source_digest(tmp_path)
    (tmp_path / "nodes" / "model.py").write_text("a = 2\n")
    assert source_digest(tmp_path) == before
    (tmp_path / "force" / "model.py").write_text("a = 2\n")
    assert source_digest(tmp_path) != before


def test_a_job_depends_on_the_sources(small_scene, monkeypatch):
    now = job_of(small_scene(), 1, "bag")
    monkeypatch.setattr("cmp_tactile_simulation.recording.run.simulator_version", lambda: "another")
    assert job_of(small_scene(), 1, "bag") != now
