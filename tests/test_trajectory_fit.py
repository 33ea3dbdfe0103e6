"""Fitting motion to trajectories: the exact evidence against dense algebra, the particle filter's against the exact."""

import math

import jsonargparse
import pytest
import torch

from probtrack.dynamics import (
    CoordinateUncoupled,
    Curvilinear,
    DrivenVelocity,
    Kinematics,
    RandomWalk,
    TimeCorrelated,
    lehmann2007,
)
from probtrack.errors import InputError
from probtrack.switching import MarkovChain, SwitchingDynamics
from probtrack.training import (
    FixedPaths,
    SampledTrajectories,
    Trajectory,
    TrajectoryDataset,
    collate_trajectories,
    physical_values,
    read_trajectories,
)

lightning = pytest.importorskip("lightning")
from probtrack.training import TrajectoryDataModule, TrajectoryFit  # noqa: E402

STD, SPEED = 0.07, 0.8


def path(steps, position, name="path"):
    time = torch.cat([torch.zeros(1), torch.as_tensor(steps).cumsum(0)])
    return Trajectory(name, name, time, position)


def batch(*trajectories, order=None, longest_step=None):
    data = TrajectoryDataset(trajectories, longest_step)
    return collate_trajectories([data[n] for n in (order or range(len(data)))])


def uneven(frames=7, axes=2, name="path"):
    """A walk with time steps of its own and a gap of two rows."""
    position = (0.3 * torch.randn(frames, axes)).cumsum(0)
    position[2:4] = torch.nan
    return path(0.1 + 0.2 * torch.rand(frames - 1), position, name)


def log_evidence(fit, made, draw=0):
    """Of each trajectory (B,)."""
    return fit.outcome(made, fit.seeds(made, draw)).cloud.log_evidence.sum(0)


def dense_evidence(model, trajectory, std, speed):
    """Oracle: what one coordinate is after the first measurement, as one normal vector."""
    dt, seen = trajectory.time.diff(), trajectory.position[1:].isfinite().all(-1)
    size = model.state_dim
    map_to = torch.zeros(size, 1)  # of the state, from its velocity at the start and all noise
    map_to[1, 0] = speed
    rows = []
    for step in dt.tolist():
        F, G = (x.detach() for x in model.matrices(step))
        map_to = torch.cat([F @ map_to, G], 1)
        rows.append(map_to[0])
    width = max(map(len, rows))
    A = torch.stack([torch.nn.functional.pad(row, (0, width - len(row))) for row in rows])[seen]
    # y_t - y_1 = l_t - l_1 + e_t - e_1
    covariance = A @ A.mT + std**2 * (torch.eye(len(A)) + 1)
    law = torch.distributions.MultivariateNormal(torch.zeros(len(A)), covariance)
    return law.log_prob((trajectory.position[1:] - trajectory.position[0])[seen].mT).sum()


@pytest.mark.parametrize("printed", [True, False])
@pytest.mark.parametrize("name", ["CU-RWVE", "CU-TCVE", "CU-TCAC", "CU-LAN", "CU-LAN-ORIG"])
def test_exact_evidence_is_that_of_the_joint_law(name, printed):
    walks = [uneven(7), uneven(5)]
    fit = TrajectoryFit(lehmann2007(name, printed=printed), std=STD, speed=SPEED)
    one_axis = lehmann2007(name, 1, printed=printed)
    expected = torch.stack([dense_evidence(one_axis, walk, STD, SPEED) for walk in walks])
    torch.testing.assert_close(log_evidence(fit, batch(*walks)), expected)


def test_the_loss_is_the_mean_over_frames_of_a_run():
    walks = [uneven(7), uneven(5)]
    fit = TrajectoryFit(lehmann2007("CU-LAN"), std=STD)
    made = batch(*walks)
    torch.testing.assert_close(fit.run_loss(made, 0), -log_evidence(fit, made) / torch.tensor([6.0, 4.0]))


def two_modes():
    parts = [CoordinateUncoupled(DrivenVelocity(TimeCorrelated(*process))) for process in ((3.0, 0.3), (1.0, 1.5))]
    return SwitchingDynamics(parts, MarkovChain([0.4, 0.6], [[0.8, 0.2], [0.3, 0.7]], dt=0.1))


FITS = {
    "exact": lambda: TrajectoryFit(lehmann2007("CU-LAN"), std=STD),
    "particles": lambda: TrajectoryFit(lehmann2007("CL-RWVE-RAAC"), std=STD, num_particles=50),
    "switching": lambda: TrajectoryFit(two_modes(), std=STD, num_particles=50),
}


def losses_and_gradient(fit, made, weights):
    fit.zero_grad()
    runs = fit.run_loss(made, 3)
    (runs * weights).sum().backward()
    return runs.detach(), torch.cat([p.grad.flatten() for p in fit.parameters()])


@pytest.mark.parametrize("make", FITS.values(), ids=FITS)
def test_padding_changes_nothing(make):
    walks, fit = [uneven(4), uneven(9), uneven(6)], make()
    weights = torch.tensor([1.0, 0.0, 0.0])
    whole, gradient = losses_and_gradient(fit, batch(*walks), weights)
    alone, own = losses_and_gradient(fit, batch(*walks, order=[0]), weights[:1])
    torch.testing.assert_close(whole[:1], alone)
    torch.testing.assert_close(gradient, own)


@pytest.mark.parametrize("make", FITS.values(), ids=FITS)
def test_the_order_of_a_batch_changes_nothing(make):
    walks, fit, weights = [uneven(4), uneven(9), uneven(6)], make(), torch.rand(3)
    runs, gradient = losses_and_gradient(fit, batch(*walks), weights)
    order = [2, 0, 1]
    turned, again = losses_and_gradient(fit, batch(*walks, order=order), weights[order])
    torch.testing.assert_close(turned, runs[order])
    torch.testing.assert_close(again, gradient)


@pytest.mark.parametrize("name", ["CU-RWVE", "CU-TCAC", "CU-LAN"])
def test_a_missing_row_is_a_frame_without_a_measurement(name):
    position = (0.3 * torch.randn(8, 2)).cumsum(0)
    kept = torch.tensor([True, True, False, True, False, False, True, True])
    time = 0.1 * torch.arange(8.0)
    fit = TrajectoryFit(lehmann2007(name, printed=False), std=STD)
    missing = Trajectory("rows", "rows", time[kept], position[kept])
    empty = Trajectory("cells", "cells", time, torch.where(kept[:, None], position, torch.nan))
    expected = log_evidence(fit, batch(missing))
    torch.testing.assert_close(log_evidence(fit, batch(empty)), expected)
    torch.testing.assert_close(log_evidence(fit, batch(missing, longest_step=0.05)), expected)
    # two trajectories, one with long steps and the other with short ones, in one batch
    torch.testing.assert_close(log_evidence(fit, batch(missing, empty)), expected.expand(2))


def grouped(fit, walk, groups=20, runs=30):
    """Ratio of estimated and exact evidence, and its gradient, in groups of runs (groups, 1 + P)."""
    exact = TrajectoryFit(fit.model.dynamics, std=STD, speed=fit.speed)
    truth = log_evidence(exact, batch(walk)).detach()
    data, parameters = TrajectoryDataset([walk] * runs), list(fit.parameters())
    made, found = collate_trajectories([data[n] for n in range(runs)]), []
    for group in range(groups):
        found_log = log_evidence(fit, made, draw=group)
        ratio = (found_log - truth).exp().mean()
        found.append(torch.stack([ratio.detach(), *torch.autograd.grad(ratio, parameters)]))
    return torch.stack(found)


@pytest.mark.parametrize("rows", [[0, 1, 3, 4, 6, 7, 8, 11], [0, 1, 2, 4]], ids=["long", "short"])
def test_particle_evidence_and_its_gradient_are_unbiased(rows):
    (walk,) = SampledTrajectories(
        lehmann2007("CU-LAN"), count=1, frames=12, dt=0.1, error=STD, speed=0.4
    ).trajectories()
    walk = walk._replace(time=walk.time[rows], position=walk.position[rows])
    walk.position[2] = torch.nan
    fit = TrajectoryFit(lehmann2007("CU-LAN"), std=STD, speed=0.4, exact=False, num_particles=100)
    exact = TrajectoryFit(fit.model.dynamics, std=STD, speed=0.4)
    gradient = torch.autograd.grad(log_evidence(exact, batch(walk)).sum(), list(exact.parameters()))
    found = grouped(fit, walk)
    z = (found.mean(0) - torch.stack([torch.ones(()), *gradient])) / (found.std(0) / len(found) ** 0.5)
    assert (z.abs() < 5).all(), z
    assert (found.std(0) / len(found) ** 0.5 < 0.3 * torch.stack([torch.ones(()), *gradient]).abs().clamp_min(1)).all()


@pytest.mark.parametrize("gap", [False, True])
def test_particles_that_look_ahead_find_the_second_position(gap):
    """Of 400 velocities drawn by their law one at most leads to within 10 cm of that position a second away."""
    near = path([0.4, 0.6], torch.tensor([[0.0, 0.0], [torch.nan, 0.0], [1.2, -2.0]]))
    near = near if gap else near._replace(time=near.time[::2], position=near.position[::2])
    fit = TrajectoryFit(lehmann2007("CU-RWVE"), std=0.1, num_particles=400, exact=False)
    with torch.no_grad():
        weight = fit.outcome(batch(near), torch.tensor([5])).cloud.log_weight[-1].exp()
    assert 1 / weight.square().sum() > 20


def test_single_precision_is_close_to_double():
    walks = [uneven(7), uneven(5)]
    exact = log_evidence(TrajectoryFit(lehmann2007("CU-LAN"), std=STD), batch(*walks)).detach()
    torch.set_default_dtype(torch.float32)
    single = log_evidence(TrajectoryFit(lehmann2007("CU-LAN"), std=STD), batch(*walks))
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), exact, rtol=1e-4, atol=1e-4)


def assert_recovered(fit, truth, std, tolerance=0.1):
    true = physical_values(truth)
    for name, value in physical_values(fit.model).items():
        wanted = std if name == "likelihood.std" else true[name.removeprefix("dynamics.")]
        assert abs(value / wanted - 1) < tolerance, f"{name}: {value:.4g} for {wanted:.4g}"


def trained(fit, data, epochs):
    trainer = lightning.Trainer(
        max_epochs=epochs, accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, log_every_n_steps=1,
    )  # fmt: skip
    trainer.fit(fit, data)


@pytest.mark.filterwarnings("ignore::UserWarning", "ignore::FutureWarning", "ignore::DeprecationWarning")
def test_a_linear_model_and_the_error_are_recovered_by_the_trainer():
    truth = CoordinateUncoupled(DrivenVelocity(RandomWalk(0.3)))
    data = TrajectoryDataModule(SampledTrajectories(truth, count=60, frames=20, dt=0.1, error=0.02), batch_size=30)
    model = CoordinateUncoupled(DrivenVelocity(RandomWalk(0.6)))
    fit = TrajectoryFit(model, std=0.04, learning_rate=0.1)
    trained(fit, data, 25)
    assert_recovered(fit, truth, 0.02)


def test_an_error_that_is_known_stays():
    fit = TrajectoryFit(lehmann2007("CU-LAN"), std=STD, learn_std=False)
    fit.run_loss(batch(uneven()), 0).sum().backward()
    assert fit.model.likelihood.log_std.grad is None
    assert "likelihood.std" not in physical_values(fit.model)


@pytest.mark.parametrize("factor", [3.0, 1 / 3.0])
def test_particles_climb_towards_the_truth(factor):
    """Along each parameter of a curvilinear model the evidence falls on both sides of the truth."""
    source = SampledTrajectories(lehmann2007("CL-RWVE-RAAC"), count=60, frames=12, dt=0.2, error=0.05, speed=0.5)
    data = TrajectoryDataset(source.trajectories())
    made = collate_trajectories([data[n] for n in range(60)])
    for number in range(3):
        fit = TrajectoryFit(lehmann2007("CL-RWVE-RAAC"), std=0.05, speed=0.5, num_particles=100)
        parameter = list(fit.parameters())[number]
        with torch.no_grad():
            parameter.add_(math.log(factor))
        (gradient,) = torch.autograd.grad(fit.run_loss(made, 0).mean(), parameter)
        assert math.log(factor) * gradient > 0


def test_a_curvilinear_model_is_recovered_by_particles():
    """96 talkers of 12 frames tell the spread of a change to 3 %; 100 particles err by a few more."""
    source = SampledTrajectories(lehmann2007("CL-RWVE-RWTU"), count=96, frames=12, dt=0.005, error=0.003)
    data, model = TrajectoryDataset(source.trajectories()), lehmann2007("CL-RWVE-RWTU")
    made = collate_trajectories([data[n] for n in range(96)])
    with torch.no_grad():
        for parameter, factor in zip(model.parameters(), (1.6, 0.6), strict=True):
            parameter.add_(math.log(factor))
    fit = TrajectoryFit(model, std=0.004, num_particles=100)
    optimiser = torch.optim.Adam(fit.parameters(), lr=0.15, betas=(0.8, 0.99))
    for _ in range(20):
        optimiser.zero_grad()
        fit.run_loss(made, draw=0).mean().backward()
        optimiser.step()
    assert_recovered(fit, lehmann2007("CL-RWVE-RWTU"), 0.003, tolerance=0.15)


CURVED = ["CL-RWVE-RWTU", "CL-TCVE-TCTU", "CL-RWVE-RAAC", "CL-RWVE-RWAC", "CL-TCVE-TCAC"]


@pytest.mark.parametrize("name", CURVED)
def test_fixed_paths_are_those_of_the_motion_with_the_gradient_of_its_law(name):
    motion, size = lehmann2007(name), 40_000
    state = motion.from_kinematics(Kinematics(torch.zeros(size, 2), torch.tensor([1.2, 0.9]).expand(size, 2)))
    if motion.state_dim == 5:
        state[:, 4] = 0.7
    noise = torch.randn(size, 2)
    moved, log_weight = next(iter(FixedPaths(motion).moves(None, 0.032)))(state.requires_grad_(), noise)
    assert not moved.requires_grad
    state = state.detach()
    along = motion.transition(0.032)(state, noise)
    torch.testing.assert_close(moved, along.detach(), rtol=0, atol=0)
    torch.testing.assert_close(log_weight, torch.zeros(size), rtol=0, atol=1e-12)
    for parameter in motion.parameters():
        for variable in (0, 1, 2, -1):  # E[f w] has the gradient of E[f], f = sin(x) of a variable
            paths = slope(parameter, motion.transition(0.032)(state, noise)[:, variable].sin())
            weights = slope(parameter, weighted_sine(motion, state, noise, variable))
            difference = weights - paths
            assert abs(difference.mean()) <= 5 * difference.std() / size**0.5 + 1e-9


def weighted_sine(motion, state, noise, variable):
    moved, log_weight = next(iter(FixedPaths(motion).moves(None, 0.032)))(state, noise)
    return moved[:, variable].sin() * log_weight.exp()


def slope(parameter, values):
    """Derivatives (n,) of `values` (n,) by one parameter, each of its own."""
    pick = torch.ones_like(values, requires_grad=True)
    (total,) = torch.autograd.grad((values * pick).sum(), parameter, create_graph=True, allow_unused=True)
    if total is None or not total.requires_grad:
        return torch.zeros_like(values)
    return torch.autograd.grad(total, pick)[0]


def test_fixed_paths_need_two_axes():
    with pytest.raises(InputError, match="motion must be curvilinear with two axes"):
        FixedPaths(lehmann2007("CL-RWVE-RAAC", 3))


def test_three_axes_are_fitted_too():
    made = batch(uneven(6, axes=3))
    for name in ("CU-LAN", "CL-RWVE-RAAC"):
        assert TrajectoryFit(lehmann2007(name, 3), num_particles=20).run_loss(made, 0).isfinite().all()


def test_mistakes_are_named():
    with pytest.raises(InputError, match="exact must be False for Curvilinear"):
        TrajectoryFit(lehmann2007("CL-RWVE-RAAC"), exact=True)
    with pytest.raises(InputError, match="trajectories must have 2 axes, those of the model, got 3"):
        TrajectoryFit(lehmann2007("CU-LAN")).run_loss(batch(uneven(6, axes=3)), 0)
    for value in ({"speed": 0.0}, {"std": -1.0}, {"num_particles": 0}):
        with pytest.raises(InputError, match=next(iter(value))):
            TrajectoryFit(lehmann2007("CU-LAN"), **value)


def names(loader):
    return [name for one in loader for name in one.names]


def test_a_split_parts_files_and_keeps_their_tracks_together(tmp_path):
    for n in range(10):
        rows = [f"{t},{track},{t},{track}" for t in range(3) for track in (1, 2)]
        (tmp_path / f"{n}.csv").write_text("\n".join(["time,track,x,y", *rows]))
    data = TrajectoryDataModule(str(tmp_path), split=(0.5, 0.3, 0.2), batch_size=3, seed=1)
    parts = [names(loader) for loader in (data.train_dataloader(), data.val_dataloader(), data.test_dataloader())]
    assert [len(part) for part in parts] == [10, 6, 4]
    files = [{name.split(",")[0] for name in part} for part in parts]
    assert len(set.union(*files)) == sum(map(len, files)) == 10


def test_training_comes_in_an_order_of_its_own_each_epoch():
    source = SampledTrajectories(lehmann2007("CU-LAN"), count=8, frames=2)
    first = TrajectoryDataModule(source, source, batch_size=3).train_dataloader()
    epochs = [names(first), names(first)]
    assert epochs[0] != epochs[1]
    assert sorted(epochs[0]) == sorted(epochs[1])
    again = TrajectoryDataModule(source, source, batch_size=3)
    assert [names(again.train_dataloader()), names(again.val_dataloader())] == [epochs[0], sorted(epochs[0])]


def test_errors_are_added_to_what_is_known_exactly(tmp_path):
    rows = [f"{t / 10},{t / 10},0" for t in range(400)]
    (tmp_path / "a.csv").write_text("\n".join(["time,x,y", *rows]))
    (exact,) = read_trajectories(tmp_path)
    data = TrajectoryDataModule(str(tmp_path), val=str(tmp_path), error=0.05)
    data.setup()
    noisy = [data.datasets[name].trajectories[0].position - exact.position for name in ("train", "val")]
    assert all(0.8 < error.std() / 0.05 < 1.2 for error in noisy)
    assert not torch.equal(*noisy)


WRONG = {
    "nothing": ({}, "at least one of train, val and test"),
    "split of two": ({"train": "a", "val": "b", "split": (0.5, 0.5, 0.0)}, "split parts the trajectories of train"),
    "shares": (
        {"train": "a", "split": (0.5, 0.6, 0.0)},
        r"split must be shares of at least 0 with sum 1, got 0.5, 0.6",
    ),
    "error": ({"train": "a", "error": -1.0}, "error must be finite and not negative"),
}


@pytest.mark.parametrize(("settings", "fault"), WRONG.values(), ids=WRONG)
def test_wrong_settings_are_named(settings, fault):
    with pytest.raises(InputError, match=fault):
        TrajectoryDataModule(**settings)


def test_parts_without_trajectories_are_named():
    source = SampledTrajectories(lehmann2007("CU-LAN"), count=2, frames=2)
    with pytest.raises(InputError, match="split leaves nothing for test: there are 2 files or walks"):
        TrajectoryDataModule(source, split=(0.6, 0.3, 0.1)).setup()
    with pytest.raises(InputError, match="there are no trajectories for train"):
        TrajectoryDataModule(val=source).train_dataloader()


CONFIGURATION = """
fit:
  dynamics: {class_path: probtrack.dynamics.lehmann2007, init_args: {name: CL-RWVE-RAAC, dt: 0.05}}
  std: 0.05
  num_particles: 30
  loss: {class_path: probtrack.training.NegativeLogEvidence}
data:
  train:
    class_path: probtrack.training.SampledTrajectories
    init_args: {dynamics: {class_path: probtrack.dynamics.lehmann2007, init_args: {name: CU-LAN}}, count: 5, frames: 4}
  val:
    class_path: probtrack.training.WalkedTrajectories
    init_args: {walk: {class_path: probtrack.simulation.trajectories.SocialForceWalk}, count: 2, duration: 1.0}
  batch_size: 4
"""


def test_a_configuration_file_says_all_of_it():
    parser = jsonargparse.ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(TrajectoryFit, "fit")
    parser.add_class_arguments(TrajectoryDataModule, "data")
    made = parser.instantiate(parser.parse_string(CONFIGURATION))
    assert isinstance(made.fit.model.dynamics, Curvilinear)
    assert len(made.data.val_dataloader()) == 1
    for one in made.data.train_dataloader():
        assert made.fit.run_loss(one, 0).isfinite().all()
