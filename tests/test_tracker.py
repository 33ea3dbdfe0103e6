"""The tracker of S1 on a small scene without echoes, whole, in pieces and in batches."""

import math
from typing import get_args

import pytest
import torch

from probtrack.errors import InputError, NotFiniteError, ShapeError
from probtrack.geometry import MicrophoneArray, Region
from probtrack.simulation import Motion
from probtrack.simulation.noise import add_noise
from probtrack.simulation.rooms import ShoeboxRoom
from probtrack.simulation.trajectories import SmoothPaths
from probtrack.trackers import lehmann2007
from probtrack.trackers.lehmann2007 import Model
from probtrack.tracks import join

FS, HOP, LENGTH, SECONDS = 16_000, 256, 512, 3.0
ROOM = (3.5, 3.1, 2.2)
PLANE = [[1.35, 0.29, 1.51], [2.15, 0.33, 1.51], [3.01, 1.15, 1.51], [2.2, 2.81, 1.51], [0.49, 1.95, 1.51]]
SPACE = [[1.35, 0.29, 0.4], [2.15, 0.33, 2.0], [3.01, 1.15, 0.7], [2.2, 2.81, 1.9], [0.49, 1.95, 0.3], [0.6, 0.5, 1.7]]
# a tenth of the peak's width, half a wave of 1.65 kHz, and the way in a frame at 1.3 m/s [m]
BOUND = 0.01 + 0.02
REGION = Region((0.1, 0.2, 0.0), (3.4, 3.0, 2.2))


def scene(array, way, seed=0):
    """Samples (M, n) of noise in bursts, spoken on the way, and the truth at the middle of each frame."""
    generator = torch.Generator().manual_seed(seed)
    walks = SmoothPaths((way,)).draw([0], num_talkers=1, duration=SECONDS, rate=FS, region=Region((0, 0, 0), ROOM))
    path = Motion(*(column[:, 0, 0] for column in walks))
    t = torch.arange(len(path.position)) / FS
    signal = torch.randn(len(t), generator=generator) * (0.02 + (t > 0.4)) * (1 + (torch.pi * 4 * t).sin())
    heard = ShoeboxRoom(ROOM, t60=0).render(signal, path, array, FS)
    middle = torch.arange((len(t) - LENGTH) // HOP + 1) * HOP + LENGTH // 2
    return add_noise(heard, 25.0, t > 0.4, generator=generator), path.position[middle]


def plane():
    return MicrophoneArray(PLANE)


@pytest.fixture(scope="module")
def walk():
    """A walk at the height of the microphones."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield scene(plane(), [(0.9, 2.3, 1.51), (1.2, 1.3, 1.51), (2.3, 1.2, 1.51)])
    torch.set_default_dtype(before)


def tracker(**settings):
    return lehmann2007(plane(), REGION, **settings)


@pytest.mark.parametrize("model", ["CU-LAN", "CU-LAN-ORIG", "CU-TCVE", "CU-TCAC", "speech-silence"])
@torch.no_grad()
def test_follows_a_walk_in_the_plane(walk, model):
    samples, truth = walk
    track = tracker(model=model, num_particles=300)(samples, torch.arange(4), truth[0, :2])
    error = (track.position - truth[:, None, :2]).norm(dim=-1)[70:]
    assert error.square().mean().sqrt() < BOUND
    toward = truth[:, :2] - plane().centre[:2]
    difference = track.azimuth - torch.atan2(toward[:, 1], toward[:, 0])[:, None]
    far = toward[70:].norm(dim=-1) > 0.5
    assert torch.atan2(difference.sin(), difference.cos())[70:][far].square().mean().sqrt() < BOUND / 0.5
    assert track.std.isfinite().all()


@torch.no_grad()
def test_finds_a_talker_anywhere(walk):
    samples, truth = walk
    track = tracker(model="CU-LAN-ORIG", num_particles=300)(samples, torch.arange(4))
    assert (track.position - truth[:, None, :2]).norm(dim=-1)[100:].square().mean().sqrt() < BOUND


SETTINGS = [
    {"resample": "residual"},
    {"exponent": 4.0},
    {"threshold": 0.5},
    {"hop": 512},
    {"keep_out": 0.7},
    {"vad_threshold": 20.0},
    {"vad_slope": 0.2},
    {"band_low": 600.0},
    {"band_high": 2000.0},
    {"speed_of_sound": 350.0},
]


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
@torch.no_grad()
def test_settings_reach_the_filter(walk, settings):
    samples, _ = walk
    assert not torch.equal(tracker(**settings)(samples).position[:90], tracker()(samples).position[:90])


@torch.no_grad()
def test_follows_a_walk_in_space():
    array = MicrophoneArray(SPACE)
    samples, truth = scene(array, [(0.9, 2.3, 0.9), (1.2, 1.3, 1.4), (2.3, 1.2, 1.7)])
    track = lehmann2007(array, REGION, three_d=True, num_particles=1000)(samples, torch.arange(3), truth[0])
    assert track.position.shape == (len(truth), 3, 3)
    error = (track.position - truth[:, None]).norm(dim=-1)[70:]
    assert error.square().mean().sqrt() < BOUND


@torch.no_grad()
def test_height_of_the_talker_matters_in_the_plane():
    array = MicrophoneArray(SPACE)
    samples, truth = scene(array, [(0.9, 2.3, 1.9), (1.2, 1.3, 1.9), (2.3, 1.2, 1.9)])
    error = []
    for height in (1.9, 0.2):
        track = lehmann2007(array, REGION, height=height, num_particles=300)(samples, torch.arange(3), truth[0, :2])
        error.append((track.position - truth[:, None, :2]).norm(dim=-1)[70:].square().mean().sqrt())
    assert error[0] < BOUND
    assert error[1] > 0.2


@pytest.mark.parametrize("vad", ["energy", "silero"])
@torch.no_grad()
def test_streaming_in_odd_blocks_is_the_whole(walk, vad):
    if vad == "silero":
        pytest.importorskip("silero_vad")
    torch.set_default_dtype(torch.float32)
    samples, machine = walk[0][:, :20_000].float(), tracker(vad=vad)
    whole = machine(samples, 5)
    sizes = [1, 255, 256, 300, 7000, 0, 511, 3]
    blocks = samples.split([*sizes, samples.shape[1] - sum(sizes)], -1)
    pieces = join(list(machine.stream(blocks, machine.begin(5))))
    for name, one, other in zip(whole._fields, whole, pieces, strict=True):
        # frames that are transformed together are rounded in another order, and a filter carries that on
        torch.testing.assert_close(one, other, rtol=2e-3, atol=2e-3, msg=lambda m, name=name: f"{name}: {m}")
    for block in (0.01, 0.3, 99):
        torch.testing.assert_close(machine(samples, 5, block=block).position, whole.position, rtol=2e-3, atol=2e-3)


@torch.no_grad()
def test_recordings_times_runs_are_each_recording_and_run_alone(walk):
    samples = torch.stack([walk[0][:, 8000:20_000], walk[0][:, 20_000:32_000]])
    machine, seeds = tracker(), torch.tensor([[1, 2, 3], [7, 8, 9]])
    together = machine(samples, seeds)
    assert together.position.shape == (45, 2, 3, 2)
    assert together.speech.shape == together.azimuth.shape == (45, 2, 3)
    for r, k in [(0, 0), (0, 2), (1, 1)]:
        alone = machine(samples[r], int(seeds[r, k]))
        for name in ("position", "std", "azimuth", "std_azimuth", "heading", "ess", "log_evidence", "speech"):
            one, other = getattr(together, name)[:, r, k], getattr(alone, name)
            torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-8)


@torch.no_grad()
def test_time_is_the_middle_of_each_frame(walk):
    machine = tracker(frame_length=400, hop=160)
    track = machine(walk[0][:, :5000], block=0.11)
    torch.testing.assert_close(track.time, 0.0125 + 0.01 * torch.arange(29))
    assert machine.dt == 0.01


@torch.no_grad()
def test_start_puts_the_cloud_there(walk):
    start = torch.tensor([2.0, 1.2])
    track = tracker(num_particles=2000)(walk[0][:, :512], start=start)  # before the first word
    assert (track.position[0] - start).norm() < 0.02
    state = tracker().begin(torch.tensor([3, 4]), torch.stack([start, start / 2 + 0.5]), start_std=0.0)
    torch.testing.assert_close(
        state.belief.state[..., :2], torch.stack([start, start / 2 + 0.5])[:, None].expand(2, 500, 2)
    )


@pytest.mark.parametrize("level", [0.0, 0.3])
@torch.no_grad()
def test_in_silence_the_cloud_spreads_and_nothing_is_nan(level):
    samples = level * torch.randn(5, 2 * FS)  # digital zeros, or noise that never rises above its floor
    track = tracker(num_particles=400)(samples, start=torch.tensor([1.7, 1.6]))
    assert all(x.isfinite().all() for x in track if x is not None)
    assert not track.lost.any()
    assert (track.std[-1] > 3 * track.std[0]).all()
    assert (track.std[::20].diff(dim=0) > 0).all()
    assert (track.speech < 0.01).all()


@torch.no_grad()
def test_silence_after_speech_lets_the_cloud_spread_again(walk):
    samples = torch.cat([walk[0][:, : 2 * FS], torch.zeros(5, FS)], -1)
    track = tracker(num_particles=300)(samples)
    assert (track.std[-1] > 2 * track.std[2 * FS // HOP - 10]).all()
    assert track.position.isfinite().all()


@torch.no_grad()
def test_level_of_the_recording_plays_no_part(walk):
    machine = tracker()
    loud, faint = (machine(gain * walk[0][:, :16_000]) for gain in (1.0, 2.0**-9))
    torch.testing.assert_close(loud.position, faint.position)


def test_gradients_reach_every_learnable_part(walk):
    machine = tracker(num_particles=40)
    machine(walk[0][:, 6000:14_000]).log_evidence.sum().backward()
    for name, parameter in machine.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name


@torch.no_grad()
def test_float32_track():
    torch.set_default_dtype(torch.float32)
    track = tracker()(torch.randn(5, 4000))
    assert track.position.dtype == torch.float32
    assert track.time.dtype == torch.float64  # of hours, to the microsecond


NAN = math.nan


@pytest.mark.parametrize("model", get_args(Model))
@pytest.mark.parametrize("three_d", [False, True])
@torch.no_grad()
def test_every_model_gives_a_track(walk, model, three_d):
    array = MicrophoneArray(SPACE if three_d else PLANE)
    made = lehmann2007(array, REGION, model, num_particles=40, three_d=three_d)
    samples = walk[0].repeat(2, 1)[: len(array.positions), :8000]
    track = made(samples, torch.arange(2))
    assert track.position.shape == (30, 2, 3 if three_d else 2)
    assert torch.isfinite(track.position).all()
    assert torch.isfinite(track.heading).all()


@torch.no_grad()
def test_modes_follow_speech(walk):
    samples, truth = walk
    track = tracker(model="speech-silence", num_particles=100)(samples, torch.arange(2), truth[0, :2])
    torch.testing.assert_close(track.mode.sum(-1), torch.ones(track.mode.shape[:-1]))
    # the chain says 99 % of what the detector says; the rest is the likelihood's
    expected = 0.01 + 0.98 * track.speech
    assert (track.mode[..., 0] - expected).abs().mean() < 0.1
    assert track.speech.min() < 0.1 < 0.9 < track.speech.max()


IMPOSSIBLE = [
    ({"num_particles": 0}, "num_particles must be an integer of at least 1, got 0"),
    ({"num_particles": 7.5}, "num_particles"),
    ({"threshold": 2}, r"threshold must be in \[0, 1\].* got 2"),
    ({"threshold": NAN}, r"threshold must be in \[0, 1\].* got nan"),
    ({"exponent": -1}, "exponent must be finite and positive, got -1"),
    ({"exponent": NAN}, "exponent must be finite and positive"),
    ({"keep_out": -0.1}, "keep_out must be finite and at least 0, got -0.1"),
    ({"keep_out": 9.0}, "the region holds no place that is keep_out = 9 m from every microphone"),
    ({"hop": 513}, "hop must be at most frame_length = 512, got 513"),
    ({"hop": 0}, "hop must be an integer of at least 1, got 0"),
    ({"frame_length": 3}, "frame_length must be an integer of at least 16"),
    ({"band_low": -1.0}, "band must satisfy"),
    ({"band_low": 3000.0}, "band must satisfy"),
    ({"band_high": 9000.0}, "band must satisfy"),
    ({"band_high": NAN}, "band must satisfy"),
    ({"band_low": 301.0, "band_high": 302.0}, "band from 301 to 302 Hz holds no bin"),
    ({"model": "CU-WALK"}, "model must be one of CU-RWVE, .*CL-TCVE-TCAC, .*moving-stopped, got 'CU-WALK'"),
    ({"vad": "ear"}, "vad must be 'energy' or 'silero', got 'ear'"),
    ({"resample": "bootstrap"}, "resample must be one of systematic, .* got 'bootstrap'"),
    ({"vad_threshold": NAN}, "vad_threshold must be finite, got nan"),
    ({"vad_slope": 0.0}, "slope must be finite and positive, got 0"),
    ({"height": 2.5}, "misses the plane that is tracked, z = 2.5 m"),
    ({"height": -0.1}, "misses the plane that is tracked, z = -0.1 m"),
    ({"height": NAN}, "misses the plane that is tracked, z = nan m"),
    ({"height": 1.0, "three_d": True}, "height is for tracking in the plane"),
    ({"speed_of_sound": 0.0}, "speed_of_sound must be finite and positive"),
    ({"speed_of_sound": NAN}, "speed_of_sound must be finite and positive"),
    ({"fs": 0}, "fs must be finite and positive, got 0"),
    ({"fs": NAN}, "fs must be finite and positive, got nan"),
]


@pytest.mark.parametrize(("settings", "message"), IMPOSSIBLE, ids=[str(s) for s, _ in IMPOSSIBLE])
def test_impossible_setting_is_named(settings, message):
    with pytest.raises(InputError, match=message):
        tracker(**settings)


@pytest.mark.parametrize(
    ("positions", "region", "settings", "message"),
    [
        ([p[:2] for p in PLANE], REGION, {"three_d": True}, "array: tracking in 3-D needs microphone positions"),
        ([p[:2] for p in PLANE], REGION, {"height": 1.0}, r"array: a height needs microphone positions \(x, y, z\)"),
        (SPACE, REGION.plane(), {"three_d": True}, "tracking in 3-D needs a region with a z range"),
        (PLANE, Region((0, 0, 0), (3, 3, 1)), {}, r"z 0 to 1 m, misses the plane that is tracked, z = 1.51 m \(the"),
        (PLANE, REGION.plane(), {"height": NAN}, "height must be finite, got nan"),
    ],
)  # fmt: skip
def test_array_region_and_height_must_go_together(positions, region, settings, message):
    with pytest.raises(InputError, match=message):
        lehmann2007(MicrophoneArray(positions), region, **settings)


@pytest.mark.parametrize("start", [(0.05, 1.0), (1.0, 3.2), (NAN, 1.0), (1.0, 1.0, 1.0), (1.0,)])
def test_start_outside_the_region_is_an_error(start):
    with pytest.raises(InputError, match=r"start .* is not inside the region x 0\.1 to 3\.4 m, y 0\.2 to 3 m"):
        tracker().begin(0, torch.tensor(start))


def test_starts_of_another_number_than_the_runs_are_an_error():
    with pytest.raises(InputError, match="start must be one point or one for each of seeds"):
        tracker().begin(torch.arange(3), torch.ones(2, 2))


@pytest.mark.parametrize("std", [-0.1, NAN, math.inf])
def test_start_std_must_be_a_distance(std):
    with pytest.raises(InputError, match="start_std must be finite and not negative"):
        tracker().begin(0, torch.ones(2), start_std=std)


@pytest.mark.parametrize("seeds", [0, torch.arange(3), torch.arange(4).reshape(1, 4)])
def test_every_recording_needs_a_seed(seeds):
    with pytest.raises(InputError, match=r"seeds must have shape \(2, \*runs\) for these recordings"):
        tracker()(torch.randn(2, 5, 4000), seeds)


def test_samples_must_fit():
    machine = tracker()
    with pytest.raises(InputError, match="samples are shorter than a frame: 511 of 512"):
        machine(torch.randn(5, 511))
    with pytest.raises(ShapeError, match=r"samples must have shape \(\.\.\., 5, n\)"):
        machine(torch.randn(4, 4000))
    with pytest.raises(NotFiniteError, match="samples hold NaN"):
        machine(torch.full((5, 4000), NAN))


def test_chains_are_for_the_frames_of_the_tracker():
    chain = tracker(model="odas", hop=160, frame_length=400).filter.dynamics.chain
    assert chain.dt == 0.01
    torch.testing.assert_close(chain(0.01).exp(), torch.tensor([[0.5, 0.3, 0.2]] * 4))
