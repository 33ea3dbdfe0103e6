"""The likelihood at the true position among others: the ranking loss by hand, and an exponent that is found again."""

import math

import pytest
import torch
import training_scenes

from probtrack.audio import Observations
from probtrack.dynamics import Kinematics
from probtrack.errors import InputError
from probtrack.geometry import SPEED_OF_SOUND, Region
from probtrack.training import Lehmann2007FrontEnd, Lehmann2007Settings, LikelihoodFit, SceneBatch, TruthFrames
from probtrack.training.scene_data import FrameGrid

one_talker = training_scenes.one_talker
REGION = Region(training_scenes.LOW, training_scenes.HIGH)
FRAMES, RUNS, LENGTH = 7, 2, 512


def likelihood_fit(folder, *, others=23, fixed=(), seed=0, warm_up=0, **of):
    plain = {"keep_out": 0.0, "model": "CU-RWVE"}
    tracker = Lehmann2007Settings(str(folder / "three.yaml"), **(plain | of))
    return LikelihoodFit(tracker, others=others, fixed=fixed, seed=seed, warm_up=warm_up)


def tables(fit, frames, runs):
    """Correlations (T, B, P, K) of noise from a place of its own in each frame, with as much noise besides."""
    front_end = fit.tracker.front_end
    source = torch.cat([REGION.from_unit(torch.rand(frames, runs, 2)), torch.full((frames, runs, 1), 1.5)], -1)
    way = torch.cdist(source.flatten(0, 1), training_scenes.array().positions).view(frames, runs, -1, 1)
    frequency = torch.arange(LENGTH // 2 + 1) * 16_000 / LENGTH
    signal = torch.randn(frames, runs, 1, len(frequency), dtype=torch.complex128)
    wave = signal * torch.polar(torch.ones(()), -2 * math.pi * frequency * way / SPEED_OF_SOUND)
    with torch.no_grad():
        return front_end.gcc(wave + torch.randn(wave.shape, dtype=torch.complex128))


def batch_of(gcc, speech, position, known=None):
    frames, runs = speech.shape
    known = torch.ones(frames, runs, dtype=torch.bool) if known is None else known
    truth = TruthFrames(position[:, :, None], None, None, None, None, None, known[..., None])
    array = training_scenes.array().positions.expand(runs, -1, -1)
    names, start = tuple(f"made {n}" for n in range(runs)), torch.zeros(runs, dtype=torch.long)
    return SceneBatch(names, array, FrameGrid(LENGTH, 256, 16_000), start, None, Observations(gcc, speech), truth)


def some(fit, speech=0.8, known=None):
    position = REGION.from_unit(torch.rand(FRAMES, RUNS, 2))
    return batch_of(tables(fit, FRAMES, RUNS), torch.full((FRAMES, RUNS), speech), position, known)


@pytest.mark.parametrize("others", [1, 23])
def test_a_flat_likelihood_has_the_loss_of_a_guess(one_talker, others):
    fit = likelihood_fit(one_talker, others=others)
    torch.testing.assert_close(fit.run_loss(some(fit, speech=0.0), 0), torch.full((RUNS,), math.log(1 + others)))


def test_loss_is_the_share_of_the_true_place_in_the_densities(one_talker):
    fit = likelihood_fit(one_talker, exponent=3.0)
    made = some(fit)
    outcome = fit.outcome(made, fit.seeds(made, 0))
    places, power = outcome.cloud.state, fit.tracker.filter.likelihood.power
    assert places.shape == (FRAMES, RUNS, 24, 2)
    assert torch.equal(places[:, :, 0], made.truth.position[:, :, 0])
    grid = REGION.grid(400)
    losses = torch.zeros(RUNS)
    for run in range(RUNS):
        for t in range(FRAMES):
            gcc = made.observations.gcc[t, run]
            # by hand, with the integral over the region's grid by the nearest lag
            steered = power.at(grid)(gcc) ** 3
            density = (0.2 + 0.8 * power(gcc, places[t, run]) ** 3 / steered.mean()) / REGION.volume
            losses[run] -= (density[0] / density.sum()).log() / FRAMES
    torch.testing.assert_close(fit.run_loss(made, 0), losses)


def test_others_are_even_over_the_region_and_new_in_each_epoch_and_run(one_talker):
    fit = likelihood_fit(one_talker, others=3000)
    made = some(fit)
    places = [fit.outcome(made, fit.seeds(made, draw)).cloud.state[:, :, 1:] for draw in (0, 0, 1)]
    assert torch.equal(places[0], places[1])
    assert not (places[0] == places[2]).any()
    assert not (places[0][:, 0] == places[0][:, 1]).any()
    unit = (places[0] - torch.tensor(REGION.low)) / (torch.tensor(REGION.high) - torch.tensor(REGION.low))
    assert ((unit >= 0) & (unit < 1)).all()
    count = unit[..., 0].numel()
    for power in (1, 2):  # moments of even numbers are 1 / (p + 1)
        error = (unit**power).mean((0, 1, 2)) - 1 / (power + 1)
        assert (error.abs() < 5 * (unit**power).flatten(0, 2).std(0) / count**0.5).all()


def test_unknown_and_impossible_places_count_for_nothing(one_talker):
    known = torch.ones(FRAMES, RUNS, dtype=torch.bool)
    known[2, 1], known[:, 0] = False, False
    fit = likelihood_fit(one_talker, keep_out=0.5)
    made = some(fit, known=known)
    made.truth.position[:, :, 0] = torch.tensor([2.9, 2.3])
    made.truth.position[4, 1, 0] = torch.tensor(training_scenes.MICROPHONES[0][:2])  # a mouth in a microphone
    outcome = fit.outcome(made, fit.seeds(made, 0))
    kept = known.clone()
    kept[4, 1] = False
    assert torch.equal(outcome.known, kept)
    assert torch.equal(outcome.inside, kept)
    assert torch.equal(outcome.cloud.lost, ~kept)
    loss = fit.run_loss(made, 0)
    loss.sum().backward()
    rest = [t for t in range(FRAMES) if t not in (2, 4)]
    torch.testing.assert_close(loss, torch.stack([torch.zeros(()), -outcome.cloud.log_evidence[rest, 1].mean()]))
    assert fit.tracker.filter.likelihood.log_exponent.grad.isfinite()


@pytest.mark.parametrize("exponent", [1.5, 5.0])
def test_exponent_is_found_again(one_talker, exponent):
    frames, runs, start = 12, 100, 2.8
    truth = likelihood_fit(one_talker, exponent=exponent).tracker.filter.likelihood
    fit = likelihood_fit(one_talker, others=60, exponent=start)
    gcc, speech, grid = tables(fit, frames, runs), torch.full((frames, runs), 0.9), REGION.grid(6000)
    size = REGION.cell_size(6000)
    prepared, still = truth.prepare(Observations(gcc, speech)), torch.zeros_like(grid)
    place = torch.empty(frames, runs, 2)
    with torch.no_grad():
        for t in range(frames):
            frame = type(prepared)(*(x[t] for x in prepared))
            weight = truth(frame, Kinematics(grid, still)).exp()
            place[t] = grid[weight.multinomial(1)[:, 0]]
    # within its cell a place is even: cells of 4 cm, peaks of these three microphones of 30 cm
    place += size * (torch.rand_like(place) - 0.5)
    made, log_exponent = batch_of(gcc, speech, place), fit.tracker.filter.likelihood.log_exponent
    optimiser = torch.optim.LBFGS([log_exponent], line_search_fn="strong_wolfe", max_iter=8)

    def loss():
        optimiser.zero_grad()
        value = fit.run_loss(made, 0).mean()
        value.backward()
        return value

    optimiser.step(loss)
    assert abs(log_exponent.exp().item() / exponent - 1) < 0.1


def test_likelihood_and_front_end_are_trained_and_nothing_else(one_talker):
    fit = likelihood_fit(one_talker, model="speech-silence", fixed=("front_end.gcc.whitening",))
    trained = {name for name, p in fit.model.named_parameters() if p.requires_grad}
    assert trained == {
        "front_end.gcc.log_weight",
        "front_end.vad.threshold",
        "front_end.vad.log_slope",
        "filter.likelihood.log_exponent",
    }


def test_sound_trains_the_front_end(one_talker):
    fit = likelihood_fit(one_talker, fixed=("front_end.gcc.whitening",), warm_up=4)
    sound = training_scenes.one_batch(one_talker, fit.tracker)
    loss = fit.run_loss(sound, 0)
    loss.mean().backward()
    for name, parameter in fit.model.named_parameters():
        if parameter.requires_grad:
            assert parameter.grad.isfinite().all(), name
            assert parameter.grad.any(), name
    alone = [fit.run_loss(training_scenes.one_batch(one_talker, fit.tracker, n), 0) for n in (0, 1)]
    torch.testing.assert_close(loss, torch.cat(alone))
    assert len(fit.outcome(sound, fit.seeds(sound, 0)).truth) == sound.num_frames - 4


def test_gradients_are_finite_differences(one_talker):
    fit, step = likelihood_fit(one_talker), 1e-6
    sound = training_scenes.one_batch(one_talker, fit.tracker)
    fit.run_loss(sound, 0).mean().backward()
    for name, parameter in fit.model.named_parameters():
        if not parameter.requires_grad:
            continue
        direction, values = torch.randn_like(parameter), []
        for sign in (1, -1):
            with torch.no_grad():
                parameter.add_(sign * step * direction)
                values.append(fit.run_loss(sound, 0).mean())
                parameter.add_(-sign * step * direction)
        exact = (parameter.grad * direction).sum()
        torch.testing.assert_close((values[0] - values[1]) / (2 * step), exact, rtol=1e-5, atol=1e-8, msg=name)


def test_float32_is_close_to_float64(one_talker):
    fit = likelihood_fit(one_talker, others=3)
    made = some(fit)
    exact = fit.run_loss(made, 0)
    torch.set_default_dtype(torch.float32)
    rough = likelihood_fit(one_talker, others=3)
    value = rough.run_loss(made, 0)  # the data are brought to the precision of the tracker
    assert value.dtype == torch.float32
    assert (value - exact).abs().max() < 1  # other places


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"others": 0}, "others must be an integer of at least 1, got 0"),
        ({"warm_up": -1}, "warm_up must be an integer of at least 0, got -1"),
        ({"fixed": ("vad",)}, "fixed: no parameter begins with 'vad': there are front_end.gcc.log_weight"),
        ({"fixed": ("front_end", "filter.likelihood")}, "fixed must leave a parameter to train"),
    ],
)
def test_refuses_settings(one_talker, settings, match):
    with pytest.raises(InputError, match=match):
        likelihood_fit(one_talker, **settings)


def test_front_end_settings_are_those_of_the_tracker(one_talker):
    fit = likelihood_fit(one_talker, front_end=Lehmann2007FrontEnd(frame_length=256, hop=128))
    with pytest.raises(InputError, match="same frame_length, hop and fs"):
        fit.run_loss(some(likelihood_fit(one_talker)), 0)
