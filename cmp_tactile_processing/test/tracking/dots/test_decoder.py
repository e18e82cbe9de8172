"""Pieces of a coded sheet are placed by their dots, and only where that is sure."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from cmp_tactile_processing.sensor.dot_code import dot_map
from cmp_tactile_processing.tracking.dots import MISREAD, Decoding, DotDecoder

# Checkers that touch 5 x 6 corners.
PIECE = (6, 7)


def _bits(dots: NDArray[np.bool_]) -> NDArray[np.int8]:
    return np.where(dots, 1, -1).astype(np.int8)


def _misread(bits: NDArray[np.int8], share: float, rng: np.random.Generator) -> NDArray[np.int8]:
    """With exactly that share of the bits wrong, rounded."""
    wrong = np.zeros(bits.size, bool)
    wrong[rng.permutation(bits.size)[: round(share * bits.size)]] = True
    return np.where(wrong.reshape(bits.shape), -bits, bits).astype(np.int8)


def _decode(decoder: DotDecoder, bits: NDArray[np.int8], dark: bool) -> Decoding:
    found = decoder.decode(bits, dark)
    assert found is not None
    return found


@pytest.mark.parametrize(("size", "least"), [(21, 90), (42, 80), (61, 70)])
def test_thirty_corners_with_misread_dots(size: int, least: int) -> None:
    """At 5 % of dots misread most pieces of 5 x 6 corners have a place, and none a wrong one."""
    sheet = dot_map(size, size)
    decoder, rng = DotDecoder(sheet, True), np.random.default_rng(size)
    placed = 0
    for _ in range(100):
        first = rng.integers(0, np.array(sheet.shape) - PIECE + 1)
        piece = sheet[first[0] : first[0] + PIECE[0], first[1] : first[1] + PIECE[1]]
        found = _decode(decoder, _misread(_bits(piece), 0.05, rng), first.sum() % 2 == 0)
        if found.is_certain:
            placed += 1
            assert (found.turns, found.mirrored, found.exchanged) == (0, False, False)
            np.testing.assert_array_equal(found.shift, first)
            assert found.misread == 2
        assert not found.is_foreign
    assert placed >= least


def test_odds_are_those_of_bayes() -> None:
    """Against a loop over all places, with weights as described."""
    sheet = dot_map(7, 9, 5)
    piece = _misread(_bits(sheet[2:6, 3:8]), 0.05, np.random.default_rng(0))
    found = _decode(DotDecoder(sheet, True), piece, False)
    likelihoods = {}
    for mirrored in (False, True):
        for turns in range(4):
            image = np.rot90(_bits(sheet), turns)
            colour = np.rot90(np.indices(sheet.shape).sum(axis=0) % 2 == 0, turns)
            if mirrored:
                image, colour = image[:, ::-1], colour[:, ::-1]
            for i in range(-3, image.shape[0]):
                for j in range(-4, image.shape[1]):
                    likelihood, on_sheet = 1.0, 0
                    for a, b in np.ndindex(piece.shape):
                        u, v = i + a, j + b
                        if 0 <= u < image.shape[0] and 0 <= v < image.shape[1]:
                            same = image[u, v] == piece[a, b]
                            likelihood *= (1 - MISREAD) if same else MISREAD
                            on_sheet += 1
                        else:
                            likelihood *= 0.5
                    if on_sheet < 0.8 * piece.size:
                        continue
                    dark = bool(colour[0, 0] == ((i + j) % 2 == 0))
                    usual = not dark and not mirrored and turns == 0
                    likelihoods[mirrored, turns, i, j] = likelihood * (1.0 if usual else 1e-3)
    best = likelihoods.pop((False, 0, 2, 3))
    assert (found.readable, found.misread) == (20, 1)
    assert found.odds == pytest.approx(sum(likelihoods.values()) / best)


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("exchanged", [False, True])
def test_views_of_all_kinds(turns: int, mirrored: bool, exchanged: bool) -> None:
    sheet = dot_map(12, 15, 9)
    seen = np.rot90(_bits(sheet), turns)
    dark = np.rot90(np.indices(sheet.shape).sum(axis=0) % 2 == 0, turns)
    if mirrored:
        seen, dark = seen[:, ::-1], dark[:, ::-1]
    piece = seen[1:11, 2:11].copy()
    piece[0] = 0
    found = _decode(DotDecoder(sheet, True), piece, bool(dark[1, 2]) != exchanged)
    assert found.is_certain
    assert (found.turns, found.mirrored, found.exchanged) == (turns, mirrored, exchanged)
    np.testing.assert_array_equal(found.shift, (1, 2))
    assert (found.readable, found.misread) == (81, 0)


def test_other_sheets_are_refused() -> None:
    decoder = DotDecoder(dot_map(21, 21, 0), True)
    for seed in range(1, 6):
        whole = _decode(decoder, _bits(dot_map(21, 21, seed)), True)
        assert whole.is_foreign
        assert not whole.is_certain
        piece = _decode(decoder, _bits(dot_map(21, 21, seed)[3:9, 4:11]), False)
        assert not piece.is_certain


def test_random_dots_are_accepted_no_more_often_than_is_promised() -> None:
    """The binomial bound holds: its quantiles are reached at most as often as it says."""
    decoder, rng = DotDecoder(dot_map(21, 21), True), np.random.default_rng(3)
    chances = np.array(
        [_decode(decoder, _bits(rng.random((6, 6)) < 0.5), True).by_chance for _ in range(400)]
    )
    for level in (0.01, 0.05, 0.2):
        assert (chances <= level).mean() <= level + 3 * np.sqrt(level / len(chances))


def test_much_is_misread_of_a_large_piece() -> None:
    """A large piece is sure with a fifth of its dots misread, and foreign with half of them."""
    sheet, rng = dot_map(21, 21), np.random.default_rng(1)
    decoder = DotDecoder(sheet, False)
    assert _decode(decoder, _misread(_bits(sheet), 0.2, rng), False).is_certain
    assert _decode(decoder, _misread(_bits(sheet), 0.5, rng), False).is_foreign


def test_few_checkers_near_a_known_place() -> None:
    sheet = dot_map(21, 21)
    decoder = DotDecoder(sheet, True)
    bits = _bits(sheet[4:9, 6:11])
    assert not _decode(decoder, bits, True).is_certain
    near = decoder.decode(bits, True, (np.array([2, 4]), np.array([6, 8])))
    assert near is not None
    assert near.is_certain
    np.testing.assert_array_equal(near.shift, (4, 6))
    assert decoder.decode(bits, True, (np.array([40, 40]), np.array([50, 50]))) is None
    assert decoder.evidence(bits, np.array([4, 6])) == pytest.approx(25 * np.log(2 * (1 - MISREAD)))
    assert decoder.evidence(bits, np.array([4, 7])) < 0


def test_nothing_read() -> None:
    assert DotDecoder(dot_map(9, 9), True).decode(np.zeros((4, 4), np.int8), True) is None
