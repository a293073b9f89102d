"""Plots of sizes have the same bytes each time, and their axes include all times and all memory."""

from contextlib import contextmanager

import numpy as np
import pytest
from helpers.benchmark_rows import measured
from PIL import Image

from kissgs import UnsupportedError
from kissgs.benchmark import scaling_plot as module
from kissgs.benchmark.scaling_plot import scaling_plot

ROWS = [
    measured(codec, 9, 30.0, gaussians=n, seconds=n / 1e4 * k, memory=10**8 + 700 * n * k, external=codec == "spz")
    for k, codec in ((1, "fast"), (5, "paper"), (9, "small"), (2, "spz"))
    for n in (1000, 10_000, 2_000_000)
]


@pytest.fixture
def figures(monkeypatch):
    """Return the list of the figures that are drawn."""
    drawn, real = [], module.new_figure

    @contextmanager
    def recording(*args):
        with real(*args) as figure:
            drawn.append(figure)
            yield figure

    monkeypatch.setattr(module, "new_figure", recording)
    return drawn


def test_a_plot_has_the_same_bytes_each_time(tmp_path):
    path = tmp_path / "plot.pdf"
    scaling_plot(ROWS, path)
    data = path.read_bytes()
    assert data.startswith(b"%PDF")
    scaling_plot(ROWS, path)
    assert path.read_bytes() == data


def test_the_axes_include_all_times_and_all_memory(tmp_path, figures):
    """The slowest and largest preset is the last one here, and the scene's own size the smallest memory."""
    scaling_plot(ROWS, tmp_path / "p.png")
    panels = figures[0].axes
    expected = [f"{name}: {what}" for name in ("fast", "paper", "small") for what in ("seconds", "peak memory")]
    assert [axes.get_title() for axes in panels] == [*expected, "all: CPU seconds", "all: peak memory"]
    for axes in panels:
        low, high = axes.get_ylim()
        assert len(axes.get_lines()) >= 3
        assert all(low < value < high for line in axes.get_lines() for value in line.get_ydata())


def test_codecs_are_compared_with_the_size_of_the_scene(tmp_path, figures):
    scaling_plot(ROWS, tmp_path / "p.png")
    seconds, memory = figures[0].axes[-2:]
    lines = {line.get_label(): line for line in memory.get_lines()}
    assert set(lines) == {"fast", "paper", "small", ".spz", "the scene as float32"}
    assert set(lines["the scene as float32"].get_ydata()) == {4 * (14 + 9)}
    assert lines["paper"].get_ydata()[-1] == pytest.approx(50 + 700 * 5)
    assert lines[".spz"].get_linestyle() == "--"
    assert seconds.get_lines()[0].get_ydata() == pytest.approx([0.2, 2.0, 400.0])


def test_a_plot_of_one_measurement_is_drawn(tmp_path):
    scaling_plot(ROWS[:1], tmp_path / "p.png")
    assert np.asarray(Image.open(tmp_path / "p.png").convert("L")).std() > 5


def test_a_scene_without_gaussians_is_refused(tmp_path):
    with pytest.raises(UnsupportedError, match="a scene without Gaussians cannot be plotted"):
        scaling_plot([measured("fast", 9, 30.0, gaussians=0)], tmp_path / "p.png")
