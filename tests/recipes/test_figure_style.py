"""The look of figures: colours that can be told apart, labels that do not lie on each other, files that repeat."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_rgb

from nht.recipes.figure_style import (
    PALETTE,
    label_ends,
    looks,
    save_figure,
    short,
    spread,
    style,
    thousands,
)

PLACES = st.lists(st.floats(-2, 2), min_size=1, max_size=12)


@given(PLACES, st.floats(0.01, 0.5))
def test_labels_keep_their_distance_and_their_order(places, gap):
    moved = spread(places, gap)
    order = np.argsort(places, kind="stable")
    assert (np.diff(moved[order]) >= gap - 1e-9).all()


@given(PLACES, st.floats(0.01, 0.5))
def test_labels_move_no_more_than_they_must(places, gap):
    """Their middle stays, and places that are far enough apart already stay all."""
    moved = spread(places, gap)
    assert np.mean(moved) == pytest.approx(np.mean(places), abs=1e-9)
    apart = np.cumsum([gap + 0.01] * len(places)) + min(places)
    np.testing.assert_allclose(spread(apart.tolist(), gap), apart, atol=1e-9)
    np.testing.assert_allclose(spread(moved.tolist(), gap), moved, atol=1e-6)


def seen_by(colour, matrix):
    """A colour as linear RGB, through the eyes that a matrix describes."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return matrix @ linear


BLIND = {  # Machado et al. 2009, severity 1
    "protan": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deutan": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
}


@pytest.mark.parametrize("eyes", sorted(BLIND))
def test_the_colour_blind_tell_the_colours_apart(eyes):
    found = [seen_by(colour, np.array(BLIND[eyes])) for colour in PALETTE]
    apart = [np.linalg.norm(a - b) for i, a in enumerate(found) for b in found[:i]]
    assert min(apart) > 0.1
    reds = [
        seen_by(colour, np.array(BLIND[eyes])) for colour in ("#d62728", "#2ca02c")
    ]  # others' red and green
    assert min(apart) > 0.5 * np.linalg.norm(reds[0] - reds[1])


def test_many_lines_can_be_told_apart():
    found = looks(3 * len(PALETTE))
    assert len({(look["color"], look["linestyle"]) for look in found}) == 3 * len(PALETTE)
    assert {look["linestyle"] for look in looks(len(PALETTE))} == {"-"}


def test_a_figure_is_a_picture_and_a_vector_file_and_the_same_each_time(tmp_path):
    files, open_before = {}, plt.get_fignums()
    for name in ("one", "other"):
        with style():
            figure, axes = plt.subplots(figsize=(2, 1), layout="constrained")
            axes.plot([0, 1], [0, 1], label="a line")
            label_ends(axes)
            save_figure(figure, tmp_path / f"{name}.png", ".svg")
        files[name] = [(tmp_path / f"{name}{suffix}").read_bytes() for suffix in (".png", ".pdf", ".svg")]
    assert files["one"] == files["other"]
    assert b"Type3" not in files["one"][1]  # fonts that editors of papers accept
    assert plt.get_fignums() == open_before


def test_labels_stand_at_the_ends_in_the_colours_of_their_lines():
    with style():
        figure, axes = plt.subplots(figsize=(3, 2), layout="constrained")
        for level, name in ((0.5, "middle"), (0.49, "near it"), (0.0, "low"), (np.nan, "nothing")):
            axes.plot([0, 1, 2], [level, level, level], label=name)
        axes.plot([0, 1], [1, 1], label="_hidden")
        label_ends(axes)
    texts = {text.get_text(): text for text in axes.texts}
    assert set(texts) == {"middle", "near it", "low"}
    assert texts["low"].get_color() == axes.lines[2].get_color()
    figure.canvas.draw()
    boxes = [text.get_window_extent() for text in axes.texts]
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])
    plt.close(figure)


@pytest.mark.parametrize(
    ("steps", "text"), [(0, "0"), (200, "200"), (50_000, "50k"), (2_500_000, "2.5M"), (1e6, "1M")]
)
def test_steps_are_short(steps, text):
    assert short(steps) == text


def test_curves_begin_at_zero():
    figure, axes = plt.subplots()
    axes.plot([10_000, 20_000], [0, 1])
    thousands(axes)
    assert axes.get_xlim()[0] == 0
    plt.close(figure)
