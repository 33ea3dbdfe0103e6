"""How many particles does it take, and what does accuracy cost? N from 25 to 10 000.

python -m experiments.particles --workers 2

Two motion models on S1's five ways at 20 dB. Prints error, track loss, what the clouds state of themselves and the
processor time of a run, and draws them over N.
"""

from dataclasses import dataclass
from pathlib import Path

from experiments.command import run
from experiments.lehmann2007_recordings import Talker, recordings
from experiments.monte_carlo import METRICS, done, trackers
from probtrack.evaluation import Store, StudyFile
from probtrack.evaluation.pictures import plot_study
from probtrack.evaluation.rendering import as_markdown
from probtrack.evaluation.tables import StudyTable, tabulate

NUM_PARTICLES = (25, 50, 75, 100, 200, 500, 1000, 2000, 5000, 10_000)


@dataclass(frozen=True)
class Config:
    """Track every recording 20 times with each model and number of particles."""

    models: tuple[str, ...] = ("CU-LAN", "CU-LAN-ORIG")
    num_particles: tuple[int, ...] = NUM_PARTICLES
    talker: Talker = "natural"
    runs: int = 20
    workers: int = 2
    quick: bool = False  # one recording, 25 and 75 particles, 4 runs
    out: Path = Path("build/lehmann2007")  # folder of the recordings, of the store and of the picture


def main(config: Config) -> StudyTable:
    """Do the study, draw and print it, and return its table."""
    numbers, ways, runs = ((25, 75), 1, 4) if config.quick else (config.num_particles, 5, config.runs)
    file = StudyFile(
        scenes=[*recordings(config.out, 0.27, ways=ways, talker=config.talker)],
        trackers=trackers(config.models, {}),
        vary={"num_particles": [*numbers]},
        metrics=METRICS,
        runs=runs,
    )
    name = f"particles-{config.talker}{'-quick' if config.quick else ''}"
    with Store(done(file, config.out / f"{name}.sqlite", config.workers)) as store:
        shown = ["rmse", "track_loss", "seconds"]
        plot_study(store, config.out / f"{name}.png", x="num_particles", metrics=shown, log_x=True)
        table = tabulate(store, rows=["num_particles"], columns=["tracker"], metrics=[*METRICS, "seconds"])
    print(as_markdown(table))
    return table


if __name__ == "__main__":
    run(main, Config)
