"""Random numbers of one purpose are not those of another."""

from itertools import product

from cmp_tactile_simulation.rendering.random_streams import Purpose, random_stream


def test_no_two_purposes_seeds_or_frames_share_numbers():
    keys = list(product(Purpose, range(14), range(14)))
    assert len({int(random_stream(*key).integers(2**63)) for key in keys}) == len(keys)
