"""`probtrack plot`: a picture of tracks, or of a recording that is tracked for it."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

from jsonargparse import ArgumentParser, Namespace

from probtrack.cli import flags
from probtrack.cli.track import add_tracking, prepared, track_to
from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray, Region
from probtrack.plotting import check_picture, plot_tracks
from probtrack.track_files import SUFFIXES, TrackTable, TrackWriter, read_track


def parser() -> ArgumentParser:
    """Return the command's parser."""
    by = flags.parser(
        "plot",
        "Draw tracks: x, y and azimuth against time, speech, and the room from above. A recording is tracked first, "
        "with the flags of probtrack track.",
    )
    by.add_argument("inputs", type=str, nargs="+", help="track files, or one recording")
    by.add_argument("-o", "--output", type=str, help="picture: .png, .pdf or .svg")
    by.add_argument("--truth", type=str, help="track file with the truth, drawn dashed")
    add_tracking(by)
    return by


def run(argv: Sequence[str]) -> int:
    """Run the command; returns its exit code."""
    args = flags.parsed(parser(), argv)
    if args.output is None:
        raise InputError("-o is needed: the picture to write")
    check_picture(args.output)
    truth = read_track(args.truth) if args.truth else None
    recordings = [path for path in args.inputs if Path(path).suffix.lower() not in SUFFIXES]
    if recordings and len(args.inputs) > 1:
        raise InputError(f"{recordings[0]}: give either one recording or track files ({', '.join(SUFFIXES)})")
    if recordings:
        tables, array, region = _tracked(args, recordings[0])
    else:
        tables = [read_track(path) for path in args.inputs]
        path = flags.array_path(args.array) if args.array else None
        array = MicrophoneArray.from_yaml(path) if path else None
        region = flags.region(args.region) if args.region else Region.from_yaml(path) if path else None
    plot_tracks(tables, args.output, truth=truth, array=array, region=region)
    return 0


def _tracked(args: Namespace, audio: str) -> tuple[list[TrackTable], MicrophoneArray | None, Region | None]:
    args.audio = audio
    job = prepared("plot", args)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{Path(audio).stem}.csv"
        with TrackWriter.open(path) as writer:
            track_to(writer, job)
        return [read_track(path)], job.array, job.region
