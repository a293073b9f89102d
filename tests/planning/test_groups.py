"""Groups of Gaussians that stay together in a container. Oracle: the order of the container, sorted by group."""

import numpy as np
import pytest
from helpers.codec_scenes import random_scene
from helpers.random_sensitivity import random_sensitivity

import kissgs
from kissgs import Settings
from kissgs.core.errors import UnsupportedError
from kissgs.planning import planner
from kissgs.planning.planner import plan_encoding
from kissgs.sog.encode import SOG, write_files
from kissgs.sogxt.container import zip_bytes

SCENE = kissgs.clean(random_scene(600, 1))[0]
GROUPS = np.random.default_rng(0).integers(0, 7, 600).astype(np.uint16)


def order_of(settings, sensitivity, groups):
    plan = plan_encoding(SCENE, settings, sensitivity=sensitivity, container=SOG, groups=groups)
    return write_files(plan, settings)


@pytest.mark.parametrize(("classes", "order"), [(None, "hilbert"), (1, "refined"), (3, "hilbert"), (3, "refined")])
def test_groups_follow_one_another(classes, order):
    """Without sensitivity, and with one or several classes of steps inside each group."""
    settings, sensitivity = Settings.research("fast", order=order).encode, None
    if classes is not None:
        settings = Settings.research("balanced", order=order, step_classes=classes, prune_threshold_bits=0).encode
        sensitivity = random_sensitivity(SCENE)
    encoded = order_of(settings, sensitivity, GROUPS)
    assert (np.diff(GROUPS[encoded.order].astype(int)) >= 0).all()
    assert len(np.unique(encoded.order)) == len(encoded.order)
    decoded = kissgs.decompress(zip_bytes(encoded.files))
    np.testing.assert_allclose(decoded.means, SCENE.means[encoded.order], atol=0.1 * np.ptp(SCENE.means))
    alone = order_of(settings, sensitivity, None)
    assert not (np.diff(GROUPS[alone.order].astype(int)) >= 0).all()
    same = order_of(settings, sensitivity, np.zeros(600, np.uint16))
    assert same.files == alone.files


def test_other_orders_and_too_many_groups_are_refused():
    plas = Settings.research("fast", order="plas").encode
    with pytest.raises(UnsupportedError, match="order=hilbert"):
        order_of(plas, None, GROUPS)
    many = GROUPS.copy()
    many[3] = planner.MAX_GROUPS
    with pytest.raises(UnsupportedError, match="up to 16,384 groups"):
        order_of(Settings.from_preset("fast").encode, None, many)
