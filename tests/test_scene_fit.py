"""Trackers in training on scenes: sound and what was heard of it, every gradient, seeds, and what does not fit."""

import dataclasses
import warnings

import lightning
import pytest
import torch
import training_scenes

from probtrack.dynamics import Kinematics
from probtrack.errors import InputError, ShapeError
from probtrack.filters import Adaptive, Cloud, Relocation, StopGradient, resampling
from probtrack.geometry import MicrophoneArray
from probtrack.training import (
    CloudLikelihood,
    Lehmann2007FrontEnd,
    Lehmann2007Settings,
    LikelihoodFit,
    NegativeLogEvidence,
    Outcome,
    SceneDataModule,
    SceneDataset,
    SceneFit,
    SquaredError,
    WeightedSum,
    collate,
)
from probtrack.training.hearing import heard

one_talker = training_scenes.one_talker
FRONT_END = Lehmann2007FrontEnd(frame_length=400, hop=320, vad_threshold=6.0)
BOTH = WeightedSum((NegativeLogEvidence(), CloudLikelihood(0.2)), (1.0, 0.5))
NEVER = Adaptive(resampling.systematic, 0.0)
CARRIED = Adaptive(StopGradient(resampling.systematic), 0.6)


def settings(folder, **changes):
    plain = {"num_particles": 30, "resample": NEVER, "front_end": FRONT_END}
    return Lehmann2007Settings(str(folder / "three.yaml"), **(plain | changes))


def scene_fit(folder, loss=BOTH, *, of=None, **changes):
    return SceneFit(settings(folder, **(of or {})), loss, **({"warm_up": 3, "window": None} | changes))


def data(folder, **changes):
    """The recordings, as sound on the tracker's frames."""
    made = settings(folder).make()
    return SceneDataset(folder / "set", **({"stft": made.front_end.stft} | changes))


def batch(folder, *numbers, **changes):
    dataset = data(folder, **changes)
    return collate([dataset[number] for number in numbers or range(len(dataset))])


def observed(folder, cache, **changes):
    front_end = dataclasses.replace(FRONT_END, **changes).make(training_scenes.array(), 16_000)
    return batch(folder, front_end=front_end, stft=None, cache=cache)


def test_sound_and_what_the_same_front_end_hears_of_it_have_the_same_loss(one_talker, tmp_path):
    fit = scene_fit(one_talker)
    sound, kept = batch(one_talker), observed(one_talker, tmp_path)
    assert sound.observations is None
    assert kept.audio is None
    one, other = fit.run_loss(sound, 3), fit.run_loss(kept, 3)
    # correlations are kept in half precision: relative errors of 2^-11 in powers of them, and their logarithms
    torch.testing.assert_close(other, one, rtol=0, atol=4 * 2**-11)
    assert (fit.run_loss(sound, 4) - one).abs().min() > 4 * 2**-11


def test_voice_activity_after_the_warm_up_is_that_of_the_whole_recording(one_talker):
    tracker, sound = settings(one_talker).make(), batch(one_talker)
    whole, late = heard(tracker, sound, 0), heard(tracker, sound, 17)
    assert len(late.speech) == sound.num_frames - 17
    assert torch.equal(late.speech, whole.speech[17:])
    torch.testing.assert_close(late.gcc, whole.gcc[17:])
    _, straight = tracker.front_end.step(None, sound.audio.double())
    torch.testing.assert_close(whole.speech, straight.speech)
    cut = sound._replace(audio=sound.audio[..., 17 * FRONT_END.hop :])
    assert (heard(tracker, cut, 0).speech - late.speech).abs().max() > 0.1  # or nothing was learned of the floor


def test_front_end_observations_lose_the_warm_up_too(one_talker, tmp_path):
    tracker, kept = settings(one_talker).make(), observed(one_talker, tmp_path)
    assert torch.equal(heard(tracker, kept, 5).speech, kept.observations.speech[5:])
    assert torch.equal(heard(tracker, kept, 5).gcc, kept.observations.gcc[5:])


def test_outcome_begins_around_the_talker_after_the_warm_up(one_talker):
    fit, sound = scene_fit(one_talker, start_std=1e-4, warm_up=9), batch(one_talker)
    made = fit.outcome(sound, fit.seeds(sound, 0))
    assert made.truth.shape == (sound.num_frames - 9, 2, 2)
    assert torch.equal(made.truth, sound.truth.position[9:, :, 0, :2].double())
    assert torch.equal(made.known, sound.truth.known[9:, :, 0])
    off = made.kinematics.position[0] - made.truth[0, :, None]
    assert off.abs().max() < 10 * fit.tracker.dt  # m: a frame at no more than ten times the speed of the cloud


@pytest.mark.parametrize("window", [None, 11])
def test_every_part_of_a_tracker_gets_a_gradient(one_talker, window):
    of = {"model": "speech-silence", "relocation": Relocation(share=0.3, share_silence=0.2), "resample": CARRIED}
    fit, sound = scene_fit(one_talker, of=of, window=window), batch(one_talker)
    fit.run_loss(sound, 0).mean().backward()
    trained = {name: p for name, p in fit.model.named_parameters() if p.requires_grad}
    assert {name.rpartition(".")[2] for name in trained} >= {"threshold", "log_slope", "log_weight", "log_exponent"}
    assert {name.split(".")[1] for name in trained} >= {"dynamics", "likelihood", "relocation", "vad", "gcc"}
    assert "filter.dynamics.chain.logit_transition" in trained
    for name, parameter in trained.items():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name
    assert fit.model.front_end.gcc.whitening.grad is None


@pytest.mark.parametrize("loss", [BOTH, SquaredError()], ids=["both", "squared error"])
def test_gradients_are_finite_differences_where_nothing_is_drawn_again(one_talker, loss):
    fit, sound, step = scene_fit(one_talker, loss), batch(one_talker), 1e-5
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
        # central differences: an error of step^2, and rounding over step
        exact = (parameter.grad * direction).sum()
        torch.testing.assert_close((values[0] - values[1]) / (2 * step), exact, rtol=1e-5, atol=1e-8, msg=name)
        assert exact.abs() > 1e-6, name


def test_loss_of_a_recording_does_not_depend_on_the_batch_it_sits_in(one_talker):
    fit = scene_fit(one_talker, of={"resample": CARRIED, "relocation": Relocation()})
    together, turned = (fit.run_loss(batch(one_talker, *order), 2) for order in ((0, 1), (1, 0)))
    alone = torch.cat([fit.run_loss(batch(one_talker, number), 2) for number in (0, 1)])
    torch.testing.assert_close(together, alone, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(turned, alone.flip(0), rtol=1e-9, atol=1e-9)
    assert len(set(fit.seeds(batch(one_talker), 2).tolist())) == 2


def test_crops_of_a_recording_have_random_numbers_of_their_own(one_talker):
    fit, one = scene_fit(one_talker), batch(one_talker)
    later = one._replace(start=one.start + 1)
    assert not set(fit.numbers(one)) & set(fit.numbers(later))


def test_loss_of_the_proposal_is_added_where_there_is_one(one_talker):
    sound = batch(one_talker)
    fit = scene_fit(one_talker, SquaredError(), of={"relocation": Relocation(share=0.3)})
    made = fit.outcome(sound, fit.seeds(sound, 0))
    weight = made.cloud.log_weight.exp()
    exact = SquaredError()(made) - (weight * made.cloud.log_proposal).sum(-1).mean(0)
    torch.testing.assert_close(fit.run_loss(sound, 0), exact)


@pytest.mark.parametrize("kind", ["scenes", "likelihood"])
def test_talker_within_the_keep_out_is_not_nan(one_talker, kind):
    sound, of = batch(one_talker), {"keep_out": 1.7}  # m: as far as the talker is at first
    fit = LikelihoodFit(settings(one_talker, **of)) if kind == "likelihood" else scene_fit(one_talker, of=of)
    likelihood = fit.tracker.filter.likelihood
    possible = likelihood.possible(sound.truth.position[:, :, 0, :2].double())
    assert possible.any()
    assert not possible.all()
    fit.run_loss(sound, 0).mean().backward()
    gradients = [p.grad for p in fit.model.parameters() if p.grad is not None]
    assert gradients
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_unknown_truth_within_a_recording_is_left_out(one_talker):
    fit, sound = scene_fit(one_talker, SquaredError()), batch(one_talker)
    known = sound.truth.known.clone()
    known[20:30] = False
    moved = sound.truth.position.clone()
    moved[20:30] += 7.0
    holes = sound._replace(truth=sound.truth._replace(position=moved, known=known))
    made = fit.outcome(sound, fit.seeds(sound, 0))
    squares = (made.estimate - made.truth).square().sum(-1)
    rest = torch.cat([squares[: 20 - fit.warm_up], squares[30 - fit.warm_up :]]).mean(0)
    torch.testing.assert_close(fit.run_loss(holes, 0), rest)


@torch.no_grad()
def test_validation_tells_error_and_share_of_lost_frames(one_talker, tmp_path):
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False, "accelerator": "cpu"}
    modules = SceneDataModule(val=str(one_talker / "set"), front_end=FRONT_END, audio=True, batch_size=1)
    fit, sound = scene_fit(one_talker, of={"num_particles": 3}), batch(one_talker)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*does not have many workers.*")
        warnings.filterwarnings("ignore", message=".*LeafSpec.*is deprecated")
        trainer = lightning.Trainer(enable_model_summary=False, default_root_dir=tmp_path, **quiet)
        (said,) = trainer.validate(fit, datamodule=modules, verbose=False)
    made = fit.outcome(sound, fit.seeds(sound, 2**31))
    error = (made.estimate - made.truth).norm(dim=-1)
    assert said["val/rmse"] == pytest.approx(float(error.square().mean(0).sqrt().mean()), rel=1e-6)
    assert said["val/lost"] == pytest.approx(float((error > 0.2).double().mean()), rel=1e-6)
    assert said["val/loss"] == pytest.approx(float(fit.run_loss(sound, 2**31).mean()), rel=1e-6)
    assert 0 < said["val/lost"] < 1


def test_validation_counts_known_frames_only(one_talker, monkeypatch):
    fit, said = scene_fit(one_talker), {}
    monkeypatch.setattr(fit, "log", lambda name, value, **_: said.update({name: float(value)}))
    place = torch.tensor([[0.1, 0.0], [0.3, 0.0], [9.0, 0.0]])[:, None, None].expand(3, 2, 1, 2)
    cloud = Cloud(place, torch.zeros(3, 2, 1), torch.zeros(3, 2), torch.zeros(3, 2, dtype=torch.bool))
    known = torch.tensor([[True, False], [True, False], [False, False]])  # of the second run nothing
    made = Outcome(cloud, Kinematics(place, place), torch.zeros(3, 2, 2), known)
    fit.log_outcome(made)
    assert said == {"val/rmse": pytest.approx(0.05**0.5), "val/lost": 0.5}
    said.clear()
    fit.log_outcome(made._replace(known=torch.zeros_like(known)))
    assert said == {}


def test_works_in_single_precision(one_talker):
    torch.set_default_dtype(torch.float32)
    fit = scene_fit(one_talker)
    loss = fit.run_loss(batch(one_talker), 0)
    loss.mean().backward()
    assert loss.dtype == torch.float32
    assert loss.isfinite().all()
    assert all(p.grad is None or p.grad.isfinite().all() for p in fit.model.parameters())


def test_fixed_parameters_stay(one_talker):
    fixed = ("front_end", "filter.dynamics")
    fit = scene_fit(one_talker, fixed=fixed)
    assert [n for n, p in fit.model.named_parameters() if p.requires_grad] == ["filter.likelihood.log_exponent"]
    fit.run_loss(batch(one_talker), 0).mean().backward()
    assert fit.model.front_end.vad.threshold.grad is None


# what does not fit


def without_position(sound):
    return sound._replace(truth=sound.truth._replace(position=None))


def twice(sound):
    truth = sound.truth
    return sound._replace(
        truth=truth._replace(position=truth.position.repeat(1, 1, 2, 1), known=truth.known.repeat(1, 1, 2))
    )


def not_finite(sound):
    position = sound.truth.position.clone()
    position[3, 1] = torch.nan
    return sound._replace(truth=sound.truth._replace(position=position))


def flat(sound):
    return sound._replace(truth=sound.truth._replace(position=sound.truth.position[..., :1]))


def moved(sound):
    array = sound.array.clone()
    array[1, 2, 0] += 0.01
    return sound._replace(array=array)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (without_position, r"^0_\+20dB: has no positions in its truth, and training needs them"),
        (lambda sound: sound._replace(truth=None), r"^0_\+20dB: has no positions in its truth"),
        (twice, r"^0_\+20dB: has 2 talkers, this tracker follows one"),
        (not_finite, r"^1_\+20dB: true positions must be finite, not so in frame 3"),
        (flat, r"^0_\+20dB: has positions in 1 axes, this tracker has 2"),
        (moved, r"^1_\+20dB: has microphones 0.01 m from those of the tracker's array"),
        (lambda sound: sound._replace(array=sound.array.flip(1)), r"^0_\+20dB: has microphones 0.197231 m from those"),
        (lambda sound: sound._replace(array=sound.array[:, :2]), r"^0_\+20dB: has 2 microphones, the .* array has 3"),
        (lambda sound: sound._replace(grid=sound.grid._replace(hop=256)), r"same frame_length, hop and fs: .*256, 160"),
        (lambda sound: sound._replace(grid=sound.grid._replace(frame_length=512)), "same frame_length, hop and fs"),
        (lambda sound: sound._replace(grid=sound.grid._replace(fs=8000)), r"got \(400, 320, 8000\) and \(400, 320, 16"),
    ],
)
@pytest.mark.parametrize("kind", ["scenes", "likelihood"])
def test_refuses_recordings_that_do_not_fit(one_talker, kind, change, match):
    fit = scene_fit(one_talker) if kind == "scenes" else LikelihoodFit(settings(one_talker), warm_up=3)
    with pytest.raises(InputError, match=match) as error:
        fit.run_loss(change(batch(one_talker)), 0)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["scenes", "likelihood"])
def test_refuses_a_warm_up_that_leaves_nothing(one_talker, kind):
    sound = batch(one_talker)
    for frames in (sound.num_frames, 500):
        of = settings(one_talker)
        fit = LikelihoodFit(of, warm_up=frames) if kind == "likelihood" else SceneFit(of, BOTH, warm_up=frames)
        with pytest.raises(InputError, match=rf"warm_up must be shorter .*, got {frames} of {sound.num_frames} frames"):
            fit.run_loss(sound, 0)


def test_refuses_tables_of_another_array_or_rate(one_talker, tmp_path):
    fit, kept = scene_fit(one_talker), observed(one_talker, tmp_path)
    gcc, speech = kept.observations
    pairs, lags = gcc.shape[-2:]
    for tables in (gcc[..., 1:], gcc[..., :2, :]):
        with pytest.raises(InputError, match=rf"must have \({pairs}, {lags}\) pairs and lags, those of the tracker"):
            fit.run_loss(kept._replace(observations=type(kept.observations)(tables, speech)), 0)


def test_microphones_at_the_rounding_of_files_are_the_same(one_talker):
    sound = batch(one_talker)
    nearly = sound._replace(array=sound.array + 1e-6)
    torch.testing.assert_close(scene_fit(one_talker).run_loss(nearly, 0), scene_fit(one_talker).run_loss(sound, 0))


def test_refuses_an_array_in_the_plane_for_data_in_space(one_talker, tmp_path):
    MicrophoneArray([row[:2] for row in training_scenes.MICROPHONES]).to_yaml(tmp_path / "flat.yaml")
    made = Lehmann2007Settings(str(tmp_path / "flat.yaml"), low=(0.0, 0.0), high=(3.0, 3.0), front_end=FRONT_END)
    with pytest.raises((InputError, ShapeError)) as error:
        SceneFit(made, BOTH).run_loss(batch(one_talker), 0)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        (
            {"fixed": ("filter.likelyhood",)},
            r"fixed: no parameter begins with 'filter.likelyhood': there are front_end",
        ),
        ({"fixed": ("",)}, "fixed must leave a parameter to train"),
        ({"warm_up": -1}, "warm_up must be an integer of at least 0, got -1"),
        ({"start_std": 0.0}, "start_std must be finite and positive, got 0"),
        ({"window": 0}, "window must be an integer of at least 1, got 0"),
        ({"learning_rate": -0.1}, "learning_rate must be finite and positive"),
    ],
)
def test_refuses_settings(one_talker, changes, match):
    with pytest.raises(InputError, match=match):
        scene_fit(one_talker, **changes)
