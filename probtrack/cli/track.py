"""`probtrack track`: a recording in, a talker's track out."""

import inspect
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import torch
from jsonargparse import ArgumentParser, Namespace
from torch import Tensor

from probtrack._threads import one_thread
from probtrack.audio import Recording
from probtrack.cli import flags
from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray, Region
from probtrack.track_files import TrackWriter, check_track_output, rows_of
from probtrack.trackers import Tracker, TrackerState, lehmann2007

_BLOCK = 1.0  # s of sound that are tracked, and written, at once
_FEWEST = 3  # live microphones with which tracking still goes on when others are dead
_FLAGGED_CLIPPING = 1e-4  # share of clipped samples that deserves a word


class Job(NamedTuple):
    """A recording and the tracker for it, all checked.

    Attributes:
        recording: The channels that are used.
        array: Their microphones.
        region: Where the talker can be.
        tracker: The tracker.
        state: Its state before the first sample.
    """

    recording: Recording
    array: MicrophoneArray
    region: Region
    tracker: Tracker
    state: TrackerState


def parser() -> ArgumentParser:
    """Return the command's parser."""
    by = flags.parser("track", "Track one talker in a multichannel recording (Lehmann & Johansson 2007).")
    by.add_argument("audio", type=str, help="recording in any format that libsndfile reads, one channel a microphone")
    by.add_argument("-o", "--output", type=str, help="track file: .csv, .jsonl or .parquet; - for standard output")
    add_tracking(by)
    return by


def add_tracking(by: ArgumentParser) -> None:
    """Add the flags that say how a recording is tracked."""
    by.add_argument("--config", action="config", help="YAML file with any of these settings")
    by.add_argument("--array", type=str, help="array file with microphone positions, or the name of one that ships")
    by.add_argument("--region", type=str, help="where the talker can be, LOW:HIGH such as 0,0:3.5,3.1 [m]")
    by.add_argument("--start", type=str, help="where the talker is at first, x,y [m]; anywhere if not given")
    by.add_argument("--channels", type=str, help="channels of the file, in the array's order, such as 1-8")
    by.add_argument("--seed", type=int, default=0, help="of all random numbers")
    flags.add_signature(by, lehmann2007)


def run(argv: Sequence[str]) -> int:
    """Run the command; returns its exit code."""
    args = flags.parsed(parser(), argv)
    if args.output is None:
        raise InputError("-o is needed: where the track goes, a file or - for standard output")
    check_track_output(args.output)
    job = prepared("track", args)
    with TrackWriter.open(args.output) as writer:
        try:
            track_to(writer, job)
        except KeyboardInterrupt:
            print(f"probtrack track: interrupted: {args.output} holds the frames so far", file=sys.stderr)  # noqa: T201
            return 130
    return 0


def prepared(command: str, args: Namespace) -> Job:
    """Return the job that the parsed flags of `command` ask for, every input checked."""
    if args.array is None:
        raise InputError("--array is needed: the file with the microphone positions")
    path = flags.array_path(args.array)
    array = MicrophoneArray.from_yaml(path)
    start = None if args.start is None else torch.tensor(flags.point(args.start, "--start"))
    region = flags.region(args.region) if args.region else Region.from_yaml(path)
    if region is None:
        region = Region.around(array)
        low, high = ((",".join(f"{value:g}" for value in corner)) for corner in (region.low, region.high))
        flags.warn(command, f"no --region, and none in {path}: taking 3 m around the array, {low}:{high}")
    names = list(inspect.signature(lehmann2007).parameters)[2:]
    settings = {name: args[name] for name in names}
    tracker = lehmann2007(array, region, **settings)
    state = tracker.begin(args.seed, start)  # says what is wrong with the settings before the recording is read
    channels = flags.channel_numbers(args.channels) if args.channels else None
    recording, live = checked_recording(command, args.audio, array, channels, tracker)
    if len(live) < array.num_microphones:
        if settings["height"] is None and array.axes == 3 and not args.three_d:
            settings["height"] = float(array.centre[2])  # of all microphones, not of those that are left
        centre, array = array.centre, array.select(live)
        tracker = lehmann2007(array, region, **settings)
        tracker.filter.origin = centre  # azimuths too are about the centre of all
        state = tracker.begin(args.seed, start)
    return Job(recording, array, region, tracker, state)


def checked_recording(
    command: str, path: str, array: MicrophoneArray, channels: Sequence[int] | None, tracker: Tracker
) -> tuple[Recording, list[int]]:
    """Return the recording with its dead channels left out, and which of the array's microphones are live."""
    recording = Recording.open(path, tracker.fs, channels)
    have, want = len(recording.channels), array.num_microphones
    if have != want:
        verb = "has" if channels is None else "gives, by --channels,"
        raise InputError(
            f"{path}: {verb} {have} channels and {array.name} has {want} microphones: "
            "pick and order the channels with --channels, such as --channels 1-8"
        )
    length = tracker.front_end.stft.frame_length
    if recording.num_output_samples < length:
        raise InputError(
            f"{path}: the recording is shorter than a frame: {recording.duration * 1e3:.1f} ms of "
            f"{length / tracker.fs * 1e3:.1f} ms"
        )
    survey = recording.survey()
    number = [channel + 1 for channel in recording.channels]
    live = [i for i, flat in enumerate(survey.flat.tolist()) if not flat]
    dead = ", ".join(str(n) for i, n in enumerate(number) if i not in live)
    if not live:
        flags.warn(command, "every channel is constant: nothing will be heard")
        return recording, list(range(want))
    if len(live) < min(_FEWEST, want):
        raise InputError(f"{path}: channel {dead} constant or all zero: {len(live)} live microphones are too few")
    if dead:
        flags.warn(command, f"channel {dead} is constant or all zero: tracking with the other {len(live)}")
        recording = Recording.open(path, tracker.fs, [recording.channels[i] for i in live])
    clipped = [
        f"{n} ({share:.2%})"
        for n, share in zip(number, survey.clipped.tolist(), strict=True)
        if share > _FLAGGED_CLIPPING
    ]
    if clipped:
        flags.warn(command, f"clipped, with the share of samples at full scale: channel {', '.join(clipped)}")
    return recording, live


@torch.inference_mode()
def track_to(writer: TrackWriter, job: Job) -> None:
    """Track the recording of `job` and write the rows of each block as soon as they are known."""
    with one_thread(), _progress(job.recording) as watched:
        for track in job.tracker.stream(watched(job.recording.blocks(_BLOCK)), job.state):
            writer.write(rows_of(track))


@contextmanager
def _progress(recording: Recording) -> Iterator[Callable[[Iterable[Tensor]], Iterator[Tensor]]]:
    """Give what passes blocks on and shows, on a terminal, how far they are and the real-time factor."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[done]}"), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        bar = progress.add_task("tracking", total=recording.duration, done="")

        def watched(blocks: Iterable[Tensor]) -> Iterator[Tensor]:
            begin, heard = time.perf_counter(), 0.0
            for block in blocks:
                yield block
                heard += block.shape[-1] / recording.fs
                factor = (time.perf_counter() - begin) / heard
                progress.update(bar, completed=heard, done=f"{heard:.0f} of {recording.duration:.0f} s, x {factor:.3f}")

        yield watched
