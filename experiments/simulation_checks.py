"""Is the simulator right? What it gives, measured, against what was wanted.

python -m experiments.simulation_checks

Every line is measured on sound or on drawn walks and turns, by means that share no code with what made them.
"""

import dataclasses
import itertools
import json
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from experiments.command import run
from probtrack.geometry import SPEED_OF_SOUND, MicrophoneArray, Region, shipped_arrays, wrap_angle
from probtrack.simulation import Motion, ResponseCache, Scene, default_cache, preset
from probtrack.simulation.rooms import SPEECH, ShoeboxRoom, reverberation_time
from probtrack.simulation.trajectories import GivenPaths, SocialForceWalk, Standing, Through, Turning
from probtrack.simulation.voices import TurnTaking

FS = 16000
WIDE = Region((0.0, 0.0, 0.0), (20.0, 20.0, 3.0))

Row = tuple[str, str, str]


@dataclass(frozen=True)
class Config:
    """Measure everything; `quick` measures on less."""

    quick: bool = False
    seed: int = 0


def main(config: Config) -> dict[str, Any]:
    """Print a table of what was wanted and measured, then the same as JSON."""
    torch.set_num_threads(1)
    checks: list[Callable[[Config], list[Row]]] = [
        reverberation, delays, ratio, directivity, continuity, walking, turning, speaking, conversing, speed,
    ]  # fmt: skip
    rows = [row for check in checks for row in check(config)]
    print("| what | wanted | measured |\n|---|---|---|")
    for what, wanted, measured in rows:
        print(f"| {what} | {wanted} | {measured} |")
    print(json.dumps([dict(zip(("what", "wanted", "measured"), row, strict=True)) for row in rows]))
    return {what: measured for what, _, measured in rows}


def reverberation(config: Config) -> list[Row]:
    """T60 of the rooms of the papers, by Schroeder's method, of omnidirectional sources and of talkers."""
    rows = []
    generator = torch.Generator().manual_seed(config.seed)
    for name in ("lehmann2007", "lehmann2007-t60-0.34", "fallon2006", "klaassen2005"):
        scene = preset(name)
        room, count = scene.room, 2 if config.quick else 8
        assert isinstance(room, ShoeboxRoom)
        points = torch.tensor(room.size) * (0.15 + 0.7 * torch.rand(count, 3, generator=generator))
        mouth = 2 * math.pi * torch.rand(count, generator=generator)
        array = scene.load_array()
        omni = reverberation_time(room.impulse_responses(points, array, FS), FS)
        talker = reverberation_time(room.impulse_responses(points, array, FS, directivity=SPEECH, mouth=mouth), FS)
        for what, t60 in (("omnidirectional", omni), ("talkers", talker)):
            spread = f"{t60.mean():.3f} s in the mean, {t60.min():.3f} to {t60.max():.3f}"
            rows.append((f"T60 of {name}, {t60.numel()} responses, {what}", f"{room.t60:g} s within 10 %", spread))
    return rows


def delays(_: Config) -> list[Row]:
    """Differences of the direct sound's delays between microphones, of noise from a walking talker."""
    array = _array("lehmann2007")
    motion = _through(((0.7, 0.8, 1.5), (1.6, 1.2, 1.5), (2.7, 2.2, 1.5)), 8.0)
    x = torch.randn(len(motion.mouth), generator=torch.Generator().manual_seed(1))
    heard = ShoeboxRoom((3.5, 3.1, 2.2), 0.0).render(x, motion, array, FS)
    errors = []
    for centre in range(4000, len(x) - 4000, 2000):
        frame = heard[:, centre - 256 : centre + 256] * torch.hann_window(512)
        spectrum = torch.fft.rfft(frame, 8192)
        cross = spectrum[1:] * spectrum[:1].conj()
        lag = torch.fft.irfft(cross / cross.abs().clamp(min=1e-9), 32 * 8192).argmax(-1)
        lag = torch.where(lag > 16 * 8192, lag - 32 * 8192, lag) / 32
        away = torch.linalg.vector_norm(array.positions - motion.position[centre], dim=-1)
        emitted = (centre - away / SPEED_OF_SOUND * FS).round().long()  # the talker was there when it left the mouth
        delay = torch.linalg.vector_norm(array.positions - motion.position[emitted], dim=-1) / SPEED_OF_SOUND * FS
        errors.append((lag - (delay[1:] - delay[0])).abs())
    worst = torch.stack(errors)
    text = f"median {worst.median():.3f}, largest {worst.max():.3f} samples (peaks of correlations)"
    return [("delay differences of the direct sound, walking slowly", "geometry within 0.25 samples", text)]


def ratio(config: Config) -> list[Row]:
    """Signal-to-noise ratio over speech, from the recording less what was heard without noise."""
    errors = []
    for seed in range(1 if config.quick else 4):
        for snr in (0.0, 10.0, 20.0):
            scene = _scene(seed, snr)
            heard = scene.listen()
            audio = scene.record(heard).audio
            active = torch.stack([one.active for one in heard.recording.speech]).any(0)
            gain = (audio * heard.clean).sum() / heard.clean.square().sum()  # noise is independent of the speech
            noise = audio / gain - heard.clean
            measured = 10 * torch.log10(heard.clean[:, active].square().mean() / noise.square().mean())
            errors.append(float((measured - snr).abs()))
    return [("SNR over speech, 0 to 20 dB", "within 0.2 dB", f"largest error {max(errors):.3f} dB")]


def directivity(_: Config) -> list[Row]:
    """Level behind a talker relative to the level in front, direct sound."""
    array = MicrophoneArray([[3.0, 2.0, 1.5], [3.0, 2.1, 1.5]])
    x = torch.randn(2 * FS, generator=torch.Generator().manual_seed(2))
    power = []
    for angle in (0.0, math.pi):
        motion = _still((2.0, 2.0, 1.5), angle, len(x))
        heard = ShoeboxRoom((5.0, 4.0, 3.0), 0.0).render(x, motion, array, FS, directivity=SPEECH)[0]
        power.append(torch.fft.rfft(heard).abs().square())
    frequency = torch.fft.rfftfreq(len(x), 1 / FS)
    rows = []
    for centre, wanted in ((1000.0, 7.4), (2000.0, 13.5), (4000.0, 19.3)):
        band = (frequency > centre / 2**0.05) & (frequency < centre * 2**0.05)
        measured = 10 * math.log10(float(power[0][band].mean() / power[1][band].mean()))
        rows.append((f"front to back at {centre / 1000:g} kHz", f"{wanted} dB within 1.5 dB", f"{measured:.1f} dB"))
    return rows


def continuity(_: Config) -> list[Row]:
    """What a tone has beside it when the talker walks: clicks would be everywhere."""
    array = _array("lehmann2007")
    rows = []
    for t60 in (0.0, 0.27):
        motion = _through(((0.7, 0.8, 1.5), (1.6, 1.2, 1.5), (2.7, 2.2, 1.5)), 3.0)
        t = torch.arange(len(motion.mouth), dtype=torch.float64) / FS
        x = torch.sin(2 * torch.pi * 1000 * t) * torch.sin(torch.pi * t / 3) ** 2
        room = ShoeboxRoom((3.5, 3.1, 2.2), t60)
        heard = room.render(x, _double(motion), array, FS, directivity=SPEECH, cache=_cache())
        power = torch.fft.rfft(heard * torch.blackman_window(len(x), dtype=x.dtype)).abs().square()
        away = (torch.arange(power.shape[-1]) * FS / len(x) - 1000).abs() > 200
        worst = 10 * torch.log10(power[:, away].amax(-1) / power.amax(-1)).max()
        what = f"a walking talker's 1 kHz tone, farther than 200 Hz from it, T60 {t60:g} s"
        rows.append((what, "below -60 dB", f"{worst:.0f} dB"))
    return rows


def walking(config: Config) -> list[Row]:
    """Speeds of people who walk freely, and of those who walk in S1's room."""
    walk = SocialForceWalk()
    runs = 60 if config.quick else 300
    free = walk.draw(range(runs), num_talkers=1, duration=30.0, rate=20.0, region=WIDE)
    speed = torch.linalg.vector_norm(free.velocity[..., :2], dim=-1)[100:]
    cruising = speed.flatten(1).quantile(0.9, 0)  # what a talker reaches between stops and curves
    heights = free.position[0, ..., 2]
    array = _array("lehmann2007")
    box = ShoeboxRoom((3.5, 3.1, 2.2), 0.27).region
    inside = walk.draw(range(runs), num_talkers=2, duration=30.0, rate=20.0, region=box, microphones=array.positions)
    place = inside.position[..., :2]
    apart = torch.linalg.vector_norm(place[:, :, 0] - place[:, :, 1], dim=-1).min()
    near = torch.cdist(place.flatten(0, 2), array.positions[:, :2]).min()
    wall = torch.minimum(place, torch.tensor(box.high[:2]) - place).min()
    indoors = torch.linalg.vector_norm(inside.velocity[..., :2], dim=-1)
    moving = indoors[indoors > 0.1]
    return [
        ("desired speed, free walks", "1.34 +- 0.26 m/s", f"{cruising.mean():.2f} +- {cruising.std():.2f} m/s"),
        ("fastest", "at most 1.72 m/s", f"{speed.max():.2f} m/s"),
        ("height of the mouth", "1.6 +- 0.08 m", f"{heights.mean():.2f} +- {heights.std():.3f} m"),
        (
            "two in S1's room: nearest to a wall, a microphone, each other",
            "at least 0.3, 0.3, 0.5 m",
            f"{wall:.2f}, {near:.2f}, {apart:.2f} m",
        ),
        (
            "their speed when they walk",
            "slower than outdoors",
            f"median {moving.median():.2f} m/s, moving {100 * len(moving) / indoors.numel():.0f} % of the time",
        ),
    ]


def turning(config: Config) -> list[Row]:
    """How the largest turn rate falls with speed, where walkers must turn much."""
    runs, room = 60 if config.quick else 300, Region((0.0, 0.0, 0.0), (6.0, 6.0, 3.0))
    walk = SocialForceWalk().draw(range(runs), num_talkers=1, duration=30.0, rate=50.0, region=room)
    rate = wrap_angle(walk.body.diff(dim=0)).abs() * 50
    speed = torch.linalg.vector_norm((walk.velocity[1:] + walk.velocity[:-1])[..., :2] / 2, dim=-1)
    speeds = torch.tensor([0.5, 0.6, 0.8, 1.0, 1.2, 1.4])
    largest = torch.stack([rate[(speed - s).abs() < 0.03].quantile(0.999) for s in speeds])
    x, y = speeds.log() - speeds.log().mean(), largest.log() - largest.log().mean()
    slope = float((x * y).sum() / (x * x).sum())
    return [("largest turn rate over speed 0.5 to 1.4 m/s, exponent", "-0.8", f"{slope:.2f}")]


def speaking(config: Config) -> list[Row]:
    """How one talker speaks and pauses."""
    hours = 600.0 if config.quick else 7200.0
    turns = TurnTaking().draw(1, hours, torch.Generator().manual_seed(config.seed))[0]
    active = sum(end - start for start, end in turns) / hours
    pauses = torch.tensor([b[0] - a[1] for a, b in itertools.pairwise(turns)])
    return [
        ("speech, share of the time", "65 to 70 %", f"{100 * active:.1f} %"),
        ("pauses, median", "0.8 to 1 s", f"{pauses.median():.2f} s"),
        ("pauses, 90th percentile", "1.5 to 2 s", f"{pauses.quantile(0.9):.2f} s"),
        ("pauses, longest", "about 5 s", f"{pauses.max():.1f} s"),
    ]


def conversing(config: Config) -> list[Row]:
    """How two talkers take turns."""
    hours = 600.0 if config.quick else 7200.0
    both = TurnTaking().draw(2, hours, torch.Generator().manual_seed(config.seed))
    spoken = sorted((start, end, k) for k, turns in enumerate(both) for start, end in turns)
    pairs = itertools.pairwise(spoken)
    gaps = torch.tensor([b[0] - a[1] for a, b in pairs if a[2] != b[2]])
    return [("gap between two talkers, median", "about 0.2 s", f"{gaps.median():.2f} s")]


def speed(config: Config) -> list[Row]:
    """What a scene of S1's room costs, of a fresh cache and of one that has all its responses."""
    with tempfile.TemporaryDirectory() as folder:
        cache, scene = ResponseCache(folder), preset("lehmann2007")
        times = []
        for _ in range(1 if config.quick else 2):
            begin = time.perf_counter()
            scene.simulate(cache)
            times.append(time.perf_counter() - begin)
    warm = f"{times[1]:.1f} s" if len(times) > 1 else "not measured"
    return [
        ("8 s scene of S1's room, no response known", "at most 90 s", f"{times[0]:.1f} s"),
        ("the same, all responses known", "at most 3 s", warm),
    ]


def _scene(seed: int, snr: float) -> Scene:
    scene = preset("lehmann2007")
    return dataclasses.replace(scene, room=ShoeboxRoom((3.5, 3.1, 2.2), 0.0), seed=seed, snr_db=snr)


def _through(points: tuple[tuple[float, float, float], ...], duration: float) -> Motion:
    drawn = GivenPaths((Through(points),)).draw([0], num_talkers=1, duration=duration, rate=FS, region=WIDE)
    return Motion(*(column[:, 0, 0] for column in drawn))


def _still(point: tuple[float, float, float], angle: float, size: int) -> Motion:
    way = Turning(Standing(point), angle)
    drawn = GivenPaths((way,)).draw([0], num_talkers=1, duration=size / FS, rate=FS, region=WIDE)
    return Motion(*(column[:, 0, 0] for column in drawn))


def _double(motion: Motion) -> Motion:
    return Motion(*(column.double() for column in motion))


def _array(name: str) -> MicrophoneArray:
    return MicrophoneArray.from_yaml(shipped_arrays()[name])


def _cache() -> ResponseCache:
    return ResponseCache(default_cache())


if __name__ == "__main__":
    run(main, Config)
