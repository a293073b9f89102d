"""Plots have the same bytes each time, are not blank, and have labels that cover neither each other nor points."""

import numpy as np
import pytest
from helpers.benchmark_rows import many, measured
from PIL import Image

from kissgs import UnsupportedError
from kissgs.benchmark import comparison_plots
from kissgs.benchmark.comparison_plots import comparison_plot


@pytest.mark.parametrize(
    ("kind", "draw", "rows"),
    [("png", comparison_plot, many(photo=True)), ("svg", comparison_plot, many())],
)
@pytest.mark.quick(1)
def test_a_plot_has_the_same_bytes_each_time(tmp_path, kind, draw, rows):
    path = tmp_path / f"plot.{kind}"
    draw(rows, path)
    data = path.read_bytes()
    assert data.startswith({"png": b"\x89PNG", "svg": b"<?xml"}[kind])
    if kind == "png":
        assert np.asarray(Image.open(path).convert("L")).std() > 10
    draw(rows, path)
    assert path.read_bytes() == data


@pytest.mark.parametrize("photo", [False, True])
def test_labels_cover_neither_each_other_nor_points(tmp_path, monkeypatch, photo):
    """The points of 'small' and 'balanced' nearly coincide."""
    place_labels, boxes_by_panel = comparison_plots.place_labels, []

    def recording(figure, axes, labels):
        place_labels(figure, axes, labels)
        boxes_by_panel.append([label.get_window_extent() for label in labels])
        points = axes.transData.transform([label.xy for label in labels])
        assert not any(box.contains(*point) for box in boxes_by_panel[-1] for point in points)

    monkeypatch.setattr(comparison_plots, "place_labels", recording)
    comparison_plot(many(photo=photo), tmp_path / "p.png")
    assert [len(boxes) for boxes in boxes_by_panel] == [5] * (3 if photo else 2)
    for boxes in boxes_by_panel:
        assert not any(one.overlaps(other) for n, one in enumerate(boxes) for other in boxes[:n])


def test_a_plot_of_one_measurement_is_drawn(tmp_path):
    comparison_plot([measured("fast", 100, float("inf"))], tmp_path / "p.png")
    assert np.asarray(Image.open(tmp_path / "p.png").convert("L")).std() > 5


def test_other_formats_are_refused(tmp_path):
    with pytest.raises(UnsupportedError, match=r"ends in \.svg, \.png or \.pdf"):
        comparison_plot(many(), tmp_path / "plot.jpg")
