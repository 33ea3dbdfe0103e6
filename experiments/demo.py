"""Can a talker be tracked, scored and drawn with nothing but this checkout?

python -m experiments.demo                                    a simulated walk in S1's room
python -m experiments.demo --speech voice.wav                 the same walk with a voice of your own
python -m experiments.demo --audio rec.wav --array array.yaml   your own recording
"""

import argparse
import json
import sys
import time
from pathlib import Path

from probtrack.cli.main import main as probtrack
from probtrack.errors import InputError


def main() -> int:
    """Run the demo; returns its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("build/demo"), help="folder for everything that comes out")
    parser.add_argument("--audio", help="a recording of your own, instead of the simulated scene")
    parser.add_argument("--array", help="array file with the microphone positions of that recording")
    parser.add_argument("--speech", help="a sound file with the voice of the simulated talker")
    parser.add_argument("--seed", type=int, default=0, help="of the scene and of the tracker")
    args = parser.parse_args()
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        if args.audio:
            return track_own(args.audio, args.array, args.out, args.seed)
        if args.array:
            raise InputError("ARRAY describes a recording of your own: give AUDIO too")
        return track_simulated(args.out, args.speech, args.seed)
    except (InputError, ImportError, OSError) as error:
        print(f"demo: error: {error}", file=sys.stderr)
        return 2


def track_simulated(out: Path, speech: str | None, seed: int) -> int:
    """Simulate the scene, track it from where the talker starts, as S1 does, score and draw it."""
    from probtrack.simulation import ResponseCache, default_cache, demo_scene, save_scene

    begin = time.perf_counter()
    scene = demo_scene(seed, speech)
    recording = scene.simulate(ResponseCache(default_cache()))
    save_scene(out, scene, recording)
    simulated = time.perf_counter() - begin
    x, y = (round(v, 3) for v in recording.truth.motion.position[0, 0, :2].tolist())
    array, truth = str(out / "array.yaml"), str(out / "truth.csv")
    begin = time.perf_counter()
    code = _track(str(out / "audio.wav"), array, out, seed, "--start", f"{x},{y}")
    tracked = time.perf_counter() - begin
    if code or (code := _plot(array, out, "--truth", truth)):
        return code
    figures = _score(truth, out / "track.csv")
    voice = "a synthetic voice" if speech is None else speech
    print(f"scene      {scene.duration:g} s of {voice} walking in S1's room, {out}/ ({simulated:.0f} s to simulate)")
    print(f"room       3.5 x 3.1 x 2.2 m, T60 0.27 s, SNR {scene.snr_db:g} dB, 8 microphones")
    print(f"model      CU-LAN with 500 particles, begun at the talker's first position ({x}, {y}) m, seed {seed}")
    _print_files(out, tracked, scene.duration)
    print(f"truth      {truth}, figures in {out}/score.json")
    print(f"error      RMSE {figures['rmse']:.3f} m over {figures['frames']} frames, pauses included")
    print(f"           {figures['final_error']:.3f} m in the last 0.5 s: track {'lost' if figures['lost'] else 'kept'}")
    median, largest = (57.29578 * figures[name] for name in ("azimuth_median", "azimuth_max"))
    print(f"azimuth    median error {median:.1f} degrees, largest {largest:.1f}")
    print(f"again      probtrack track {out}/audio.wav --array {array} --start {x},{y} -o track.csv")
    return 0


def track_own(audio: str, array: str | None, out: Path, seed: int) -> int:
    """Track a recording of the user's, from anywhere, and draw it."""
    from probtrack.audio import Recording

    if array is None:
        raise InputError("AUDIO needs ARRAY too: the file with its microphone positions (docs/files.md)")
    begin = time.perf_counter()
    if code := _track(audio, array, out, seed):
        return code
    tracked = time.perf_counter() - begin
    if code := _plot(array, out):
        return code
    print(f"recording  {audio}")
    _print_files(out, tracked, Recording.open(audio).duration)
    print(f"again      probtrack track {audio} --array {array} -o track.csv")
    return 0


def _track(audio: str, array: str, out: Path, seed: int, *more: str) -> int:
    return probtrack(["track", audio, "--array", array, "-o", str(out / "track.csv"), "--seed", str(seed), *more])


def _plot(array: str, out: Path, *more: str) -> int:
    return probtrack(["plot", str(out / "track.csv"), "--array", array, "-o", str(out / "track.png"), *more])


def _score(truth: str, track: Path) -> dict[str, float]:
    from probtrack.metrics import score
    from probtrack.track_files import read_track

    figures = score(read_track(truth), read_track(track)).as_dict()
    (track.parent / "score.json").write_text(json.dumps(figures, indent=2) + "\n")
    return {name: value for name, value in figures.items() if value is not None}


def _print_files(out: Path, seconds: float, duration: float) -> None:
    print(f"track      {out}/track.csv, in {seconds:.1f} s: {seconds / duration:.2f} of real time")
    print(f"picture    {out}/track.png")


if __name__ == "__main__":
    sys.exit(main())
