"""The training loop and its checkpoints. Oracle: the scene that was rendered, calls of regularizers, the saved
state."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.training_scenes import around, cloud, same, targets_of

import kissgs
from kissgs import OutputError
from kissgs.core.context import Context, Pace
from kissgs.rendering.differentiable import plain_photometric_loss, rasterize
from kissgs.rendering.rasterizer import render, tensors_of
from kissgs.training import checkpoint
from kissgs.training.checkpoint import Checkpoint
from kissgs.training.loop import BASE_LR, TrainingPlan, continued_lr, exponential_lr, image_loss, train
from kissgs.training.model import GaussianModel

RATES = {"means": 2e-3, "scales": 5e-3, "opacities": 5e-2, "quats": 1e-3, "sh0": 1e-2, "shN": 1e-3}


def plan(steps=30, **changes):
    return TrainingPlan(
        **{
            "stage": "learn",
            "pace": Pace(steps),
            "rates": lambda done: RATES,
            "ssim_weight": 0.2,
            "mse_weight": 0.0,
            "seed": (0,),
            **changes,
        }
    )


def error(scene, targets):
    images = [render(scene, camera)[0] for camera in targets.cameras]
    return np.mean([(image - targets.image(n)) ** 2 for n, image in enumerate(images)])


def rasterize_one(parameters):
    """Return the rendering of ``parameters`` from the first camera."""
    camera = around(1)[0].camera
    image, _ = rasterize(
        parameters,
        viewmats=torch.from_numpy(camera.viewmat)[None],
        Ks=torch.from_numpy(camera.K)[None],
        width=camera.width,
        height=camera.height,
    )
    return image[0]


def dimmed(scene):
    return kissgs.Splats(
        **{name: getattr(scene, name).copy() for name in ("means", "quats", "scales", "opacities", "shN")},
        sh0=scene.sh0 * np.float32(0.5),
    )


@pytest.mark.quick(0)
def test_a_changed_scene_converges_to_the_targets():
    scene = cloud(40)
    targets, start = targets_of(scene), dimmed(scene)
    model = GaussianModel(start)
    train(model, targets, plan(200))
    assert error(model.splats(), targets) < 0.03 * error(start, targets)


def test_an_interrupted_training_resumes_exactly():
    scene = cloud(40)
    targets, whole = targets_of(scene), GaussianModel(dimmed(scene))
    train(whole, targets, plan(23))
    steps = []

    def stop(stage, fraction, note=""):
        if fraction >= 9 / 23:
            raise kissgs.Cancelled("enough")

    first = GaussianModel(dimmed(scene))
    with pytest.raises(kissgs.Cancelled):
        train(first, targets, plan(23), Context(progress=stop), after=steps.append)
    assert steps == list(range(1, 10))
    second = GaussianModel.restored(first.state(), scene)
    train(second, targets, plan(23), first=9)
    assert same(whole.splats(), second.splats())


def test_every_image_has_its_own_background():
    """The scene's own renderings on black, grey and white are targets without an error."""
    scene = cloud()
    views = [replace(view, background=np.full(3, n / 2, np.float32)) for n, view in enumerate(around(3))]
    targets = targets_of(scene, tuple(views))
    parameters = tensors_of(scene)
    for n in range(3):
        error = image_loss(parameters, targets, n, ssim_weight=0.2, mse_weight=0.0, antialiased=False, threads=1)[1]
        assert error < 1e-4
        wrong = replace(targets, backgrounds=targets.backgrounds[1:] + targets.backgrounds[:1])
        assert (
            image_loss(parameters, wrong, n, ssim_weight=0.2, mse_weight=0.0, antialiased=False, threads=1)[1]
            > 100 * error
        )


def test_the_squared_error_counts_in_the_loss():
    """The first step of Adam has the sign of the gradient; it is that of the loss by plain torch."""
    scene, signs = cloud(40), []
    targets = targets_of(scene, around(1))
    for weight in (0.0, 1e3):
        model = GaussianModel(dimmed(scene))
        train(model, targets, plan(1, mse_weight=weight))
        parameters = {name: value.requires_grad_() for name, value in tensors_of(dimmed(scene)).items()}
        target = torch.from_numpy(targets.image(0))
        plain_photometric_loss(rasterize_one(parameters), target, 0.2, weight).backward()
        gradient = parameters["sh0"].grad.numpy()
        clear = np.abs(gradient) > 1e-3 * np.abs(gradient).max()
        moved = model.splats().sh0 - dimmed(scene).sh0
        np.testing.assert_array_equal(np.sign(moved)[clear], -np.sign(gradient)[clear])
        signs.append(np.sign(gradient))
    assert (signs[0] != signs[1]).any()


class PullToOrigin:
    """Regularizer of the squared positions."""

    def __init__(self):
        self.penalized = []

    def penalty(self, step, parameters):
        self.penalized.append(step)
        return parameters["means"].square().sum() if step % 2 else None


def test_regularizers_are_called_in_every_step():
    scene, pull = cloud(40), PullToOrigin()
    model = GaussianModel(scene)
    train(model, targets_of(scene), plan(40, regularizers=(pull,)), first=3)
    assert pull.penalized == list(range(3, 40))
    assert (model.splats().means ** 2).sum() < 0.9 * (scene.means**2).sum()


def test_notes_report_running_means_of_loss_and_psnr():
    scene, notes = cloud(40), []
    targets = targets_of(scene)
    start = dimmed(scene)
    frozen = plan(3, rates=lambda done: dict.fromkeys(RATES, 0.0))
    context = Context(progress=lambda stage, fraction, note="": notes.append(note))
    train(GaussianModel(start), targets, frozen, context)
    order = [n for n, _ in zip(targets.order((0,)), range(3), strict=False)]
    losses, errors = [], []
    for n in order:
        image = torch.from_numpy(render(start, targets.cameras[n])[0])
        losses.append(float(plain_photometric_loss(image, torch.from_numpy(targets.image(n)), 0.2)))
        errors.append(float((image - torch.from_numpy(targets.image(n))).square().mean()))
    assert notes[0] == "40 Gaussians"
    assert notes[1] == f"40 Gaussians, loss {losses[0]:.4f}, PSNR {-10 * np.log10(errors[0]):.2f}"
    smooth = 0.98 * (0.98 * losses[0] + 0.02 * losses[1]) + 0.02 * losses[2]
    assert notes[3].startswith(f"40 Gaussians, loss {smooth:.4f}, PSNR")


def test_learning_rates_fall_exponentially():
    """Half-way they are the geometric mean, as in 3DGS."""
    rates = exponential_lr({"means": 2.0, "sh0": 3.0}, {"means": 1.0, "sh0": 1.0}, {"means": 0.01, "sh0": 1.0})
    assert rates(0.0) == {"means": 2.0, "sh0": 3.0}
    assert rates(0.5) == pytest.approx({"means": 0.2, "sh0": 3.0})
    assert rates(1.0) == pytest.approx({"means": 0.02, "sh0": 3.0})


def test_learning_rates_of_3dgs_continue():
    """Oracle: gsplat's trainer, which multiplies the rate of positions by 0.01 ** (1 / 30,000) after every step."""
    rates, wanted = continued_lr(BASE_LR, 30_000, 10_000), 1.6e-4
    for step in range(40_000):
        if step in (30_000, 35_000):
            assert rates((step - 30_000) / 10_000)["means"] == pytest.approx(wanted, rel=1e-6)
        wanted *= 0.01 ** (1 / 30_000)
    end = rates(1.0)
    assert end.pop("means") == pytest.approx(wanted, rel=1e-6) == pytest.approx(3.447e-7, rel=1e-3)
    assert end == {"scales": 5e-3, "opacities": 5e-2, "quats": 1e-3, "sh0": 2.5e-3, "shN": 1.25e-4}


def test_targets_of_several_sizes_and_one_gaussian():
    scene = cloud(1, 0)
    model = GaussianModel(scene)
    train(model, targets_of(scene, (*around(2, 40), *around(3, 24))), plan(6))
    assert len(model) == 1


def test_antialiased_scenes_are_trained_with_the_opacities_that_their_images_show():
    """Small Gaussians of a classic scene would be too opaque by far."""
    scene = cloud(40)
    scene = replace(scene, scales=scene.scales - np.float32(1.5), antialiased=True)
    targets, wanted = targets_of(scene), GaussianModel(scene)
    for mark in (True, False):
        options = {"ssim_weight": 0.2, "mse_weight": 0.0, "antialiased": mark, "threads": 1}
        off = image_loss(wanted.parameters, targets, 0, **options)[1]
        assert (off < 1e-6) == mark
    model = GaussianModel(replace(dimmed(scene), antialiased=True))
    before = error(model.splats(), targets)
    train(model, targets, plan(40))
    assert model.splats().antialiased
    assert error(model.splats(), targets) < 0.2 * before


STATE = {"a": np.arange(6.0).reshape(2, 3), "json": np.asarray('{"x": 1}'), "none": np.empty(0, np.float32)}


def test_a_saved_state_is_loaded(tmp_path):
    path = tmp_path / "c.npz"
    saved = Checkpoint(path, "key")
    assert saved.load() is None
    saved.save(STATE)
    found = Checkpoint(path, "key").load()
    assert found.keys() == STATE.keys()
    assert all((found[name] == STATE[name]).all() and found[name].dtype == STATE[name].dtype for name in STATE)
    assert [entry.name for entry in tmp_path.iterdir()] == ["c.npz"]


def test_checkpoints_of_other_work_are_neither_loaded_nor_overwritten(tmp_path):
    Checkpoint(tmp_path / "c.npz", "one").save(STATE)
    with pytest.raises(OutputError, match=r"checkpoint of other work.*delete it to start again"):
        Checkpoint(tmp_path / "c.npz", "other").load()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"some text", "npz", "npy"])
def test_files_that_are_no_checkpoints_are_rejected(tmp_path, content):
    path = tmp_path / "c.npz"
    if content == "npz":
        np.savez(path, x=np.zeros(3))
    elif content == "npy":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    else:
        path.write_bytes(content)
    with pytest.raises(OutputError, match=r"c\.npz is no checkpoint of kissgs; move or delete it"):
        Checkpoint(path, "key").load()


def test_damaged_checkpoints_are_rejected(tmp_path):
    path = tmp_path / "c.npz"
    Checkpoint(path, "key").save(STATE)
    data = bytearray(path.read_bytes())
    for signature, offset in ((b"PK\x03\x04", 8), (b"PK\x01\x02", 10)):
        data[data.index(signature) + offset] = 99  # an unknown compression method
    path.write_bytes(data)
    with pytest.raises(OutputError, match=r"c\.npz is no checkpoint of kissgs"):
        Checkpoint(path, "key")
    with pytest.raises(OutputError, match="is a folder; name a file"):
        Checkpoint(tmp_path, "key")


@pytest.mark.parametrize(("seconds", "due"), [(0.0, True), (1000.0, False)])
def test_a_save_is_due_after_the_interval(tmp_path, monkeypatch, seconds, due):
    monkeypatch.setattr(checkpoint, "SAVE_INTERVAL", seconds)
    assert Checkpoint(tmp_path / "c.npz", "key").due == due
    nowhere = Checkpoint(None, "key")
    nowhere.save(STATE)
    assert nowhere.load() is None
    assert not nowhere.due
