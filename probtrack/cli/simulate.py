"""`probtrack simulate`: a scene, or a data set of scenes, from a description."""

import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from jsonargparse import ArgumentParser

from probtrack._files import read_yaml
from probtrack.cli import flags
from probtrack.errors import InputError
from probtrack.simulation.data_set import DataSet, check_data_set_output, load_data_set, make_data_set, missing_scenes
from probtrack.simulation.description import described
from probtrack.simulation.estimate import Estimate, estimate
from probtrack.simulation.presets import shipped_scenes
from probtrack.simulation.rooms import ResponseCache, default_cache
from probtrack.simulation.scene_folder import check_scene_output, load_scene, save_scene
from probtrack.simulation.scenes import Scene


def parser() -> ArgumentParser:
    """Return the command's parser."""
    by = flags.parser("simulate", "Simulate recordings of talkers in rooms, with their truth (docs: Simulation).")
    by.add_argument(
        "config",
        type=str,
        help="scene or data set file (one with 'scenes' and 'count'), or a scene that ships with probtrack: "
        + ", ".join(shipped_scenes()),
    )
    by.add_argument("-o", "--out", type=str, required=True, help="folder of the scene or data set")
    by.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes that make a data set")
    by.add_argument("--cache", type=str, help="folder that keeps the responses of rooms (default: the user's cache)")
    by.add_argument("--dry-run", action="store_true", help="say what it would cost in time and disk, and make nothing")
    return by


def run(argv: Sequence[str]) -> int:
    """Run the command; returns its exit code."""
    args = flags.parsed(parser(), argv)
    if args.workers < 1:
        raise InputError(f"--workers must be at least 1, got {args.workers}")
    config, out = Path(shipped_scenes().get(args.config, args.config)), Path(args.out)
    cache = Path(args.cache) if args.cache else default_cache()
    content = read_yaml(config, "scene or data set file")
    if isinstance(content, dict) and "scenes" in content:
        data_set = load_data_set(config)
        with _naming(config):
            _data_set(data_set, out, cache, args.workers, args.dry_run)
    else:
        scene = load_scene(config)
        with _naming(config):
            _scene(scene, out, cache, args.dry_run)
    return 0


@contextmanager
def _naming(config: Path) -> Iterator[None]:
    """Name the file that said what turns out to be wrong."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{config}: {error}") from None


def _scene(scene: Scene, out: Path, cache: Path, dry_run: bool) -> None:
    check_scene_output(out)
    described(scene)  # says what could not be written before any work
    if dry_run:
        _say(_cost(estimate(DataSet((scene,), 1), out / "none", ResponseCache(cache)), out, 1))
        return
    begin = time.perf_counter()
    save_scene(out, scene, scene.simulate(ResponseCache(cache)))
    _say(f"{out}: {scene.duration:g} s of {_talkers(scene.num_talkers)}, in {time.perf_counter() - begin:.1f} s")


def _data_set(data_set: DataSet, out: Path, cache: Path, workers: int, dry_run: bool) -> None:
    check_data_set_output(data_set, out)
    if dry_run:
        _say(_cost(estimate(data_set, out, ResponseCache(cache)), out, workers))
        return
    ResponseCache(cache)  # says what is wrong with it before any work
    begin, todo = time.perf_counter(), len(missing_scenes(data_set, out))
    with _progress(data_set.count, data_set.count - todo) as show:
        for _ in make_data_set(data_set, out, cache, workers):
            show()
    took = f"{todo} made in {time.perf_counter() - begin:.0f} s" if todo else "all were there"
    _say(f"{out}: {data_set.count} scenes at {len(data_set.snr_db or (0,))} SNR: {took}")


def _cost(cost: Estimate, out: Path, workers: int) -> str:
    """Return an estimate in words."""
    free = shutil.disk_usage(_existing(out.absolute())).free
    disk = f"{_size(cost.audio_bytes)} for recordings, {_size(cost.response_bytes)} for {cost.responses} responses"
    minutes = cost.seconds / workers / 60
    spent = f"{minutes:.0f} min" if minutes >= 2 else f"{60 * minutes:.0f} s"
    return "\n".join(
        [
            f"recordings  {cost.recordings} to make, {cost.done} are there",
            f"disk        {disk}; {_size(free)} are free",
            f"time        about {spent} with {workers} worker{'s' if workers > 1 else ''}",
        ]
    )


def _existing(path: Path) -> Path:
    return path if path.exists() else _existing(path.parent)


def _size(count: int) -> str:
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.0f} MB"


def _talkers(count: int) -> str:
    return "one talker" if count == 1 else f"{count} talkers"


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")


@contextmanager
def _progress(total: int, done: int) -> Iterator[Callable[[], None]]:
    """Give what counts a finished scene, and shows how many are left and how long they will take."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("simulating"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        bar = progress.add_task("", total=total, completed=done)
        yield lambda: progress.advance(bar)
