"""Oracle: geometry by hand."""

import numpy as np
import pytest

from kissgs.cameras.render import Orbit
from kissgs.core.errors import InvalidViewsError

UP = np.array([0.0, -1, 0])
ARC = Orbit(target=np.array([1.0, 2, 3]), radius=4.0, elevation=0.3, up=UP, mid_azimuth=1.0, sweep=1.2)
FULL = Orbit(target=np.array([1.0, 2, 3]), radius=4.0, elevation=0.3, up=UP, mid_azimuth=1.0)


def azimuths(orbit, cameras):
    """Return the azimuth of each camera relative to the middle of the arc, radians."""
    middle = orbit.camera(orbit.mid_azimuth, 4, 3).position - orbit.target
    middle -= middle @ UP * UP
    side = np.cross(middle, UP)
    return np.array(
        [np.arctan2((c.position - orbit.target) @ side, (c.position - orbit.target) @ middle) for c in cameras]
    )


@pytest.mark.parametrize("orbit", [ARC, FULL])
def test_cameras_are_on_a_horizontal_circle_and_look_at_the_target(orbit):
    for camera in orbit.loop_cameras(7, 40, 30):
        offset = camera.position - orbit.target
        assert np.linalg.norm(offset) == pytest.approx(4)
        assert offset @ UP == pytest.approx(4 * np.sin(0.3))
        assert camera.viewmat[2, :3] == pytest.approx(-offset / 4)
        assert camera.viewmat[0, :3] @ UP == pytest.approx(0, abs=1e-12)
        assert camera.viewmat[1, :3] @ UP < 0


def test_a_full_circle_has_even_steps_and_no_jump_at_its_end():
    positions = [camera.position for camera in FULL.loop_cameras(9, 40, 30)]
    steps = [np.linalg.norm(a - b) for a, b in zip(positions, [*positions[1:], positions[0]], strict=True)]
    assert steps == pytest.approx([steps[0]] * 9)
    assert FULL.description == "a full circle"


@pytest.mark.parametrize("frames", [3, 8, 47, 48, 50])
def test_on_an_arc_the_azimuth_is_a_sine_of_time(frames):
    cameras = ARC.loop_cameras(frames, 40, 30)
    found = np.abs(azimuths(ARC, cameras)) * np.sign(np.sin(2 * np.pi * np.arange(frames) / frames).round(9))
    assert found == pytest.approx(0.6 * np.sin(2 * np.pi * np.arange(frames) / frames), abs=1e-9)
    if frames % 2 == 0:
        assert len({id(camera) for camera in cameras}) <= frames // 2 + 1, (
            "the way back shares the cameras of the way there"
        )


def test_cameras_of_a_sheet_go_once_from_end_to_end():
    found = azimuths(ARC, ARC.sheet_cameras(5, 40, 30))
    assert np.sort(found) == pytest.approx(0.6 * np.linspace(-1, 1, 5))
    assert (np.diff(found) > 0).all() or (np.diff(found) < 0).all()
    assert len(FULL.sheet_cameras(6, 40, 30)) == 6
    (only,) = ARC.sheet_cameras(1, 40, 30)
    assert only.position == pytest.approx(ARC.camera(1.0, 4, 3).position)


@pytest.mark.parametrize("wrong", [(0, 9, 9), (3, 0, 9), (3, 9, -1)])
def test_numbers_below_one_are_refused(wrong):
    for cameras in (ARC.loop_cameras, ARC.sheet_cameras):
        with pytest.raises(InvalidViewsError, match="at least 1 frame"):
            cameras(*wrong)
