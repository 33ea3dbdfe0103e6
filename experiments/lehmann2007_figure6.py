"""S1's Figure 6 again: error and track loss of six motion models over the level of noise, 0 to 25 dB.

python -m experiments.lehmann2007_figure6 --workers 2

Four recordings, 60 runs of each model on each: 240 runs a point, with 75 particles and N_thr = 56.25. Prints a table
and draws the picture.
"""

from dataclasses import dataclass
from pathlib import Path

from experiments.command import run
from experiments.lehmann2007_recordings import MODELS, SNR_DB, Talker, recordings
from experiments.monte_carlo import METRICS, done, trackers
from probtrack.evaluation import Store, StudyFile
from probtrack.evaluation.pictures import plot_study
from probtrack.evaluation.rendering import as_markdown
from probtrack.evaluation.tables import StudyTable, tabulate


@dataclass(frozen=True)
class Config:
    """Track every recording 60 times with each model."""

    talker: Talker = "natural"
    vad_threshold: float = 8.0  # level over the noise that is taken for speech [dB]; S1 does not say its detector's
    runs: int = 60
    workers: int = 2
    quick: bool = False  # two levels, two recordings, 4 runs
    out: Path = Path("build/lehmann2007")  # folder of the recordings, of the store and of the picture


def main(config: Config) -> StudyTable:
    """Do the study, draw and print it, and return its table."""
    snr_db, ways, runs = (SNR_DB[::5], 2, 4) if config.quick else (SNR_DB, 4, config.runs)
    scenes = recordings(config.out, 0.27, snr_db, ways=ways, talker=config.talker)
    file = StudyFile(
        scenes=[*scenes],
        trackers=trackers(MODELS, {"num_particles": 75, "vad_threshold": config.vad_threshold}),
        metrics=METRICS,
        runs=runs,
    )
    name = f"figure6-{config.talker}-{config.vad_threshold:g}dB{'-quick' if config.quick else ''}"
    with Store(done(file, config.out / f"{name}.sqlite", config.workers)) as store:
        plot_study(store, config.out / f"{name}.png", x="snr_db", metrics=["rmse", "track_loss"])
        table = tabulate(store, rows=["tracker"], columns=["snr_db"], metrics=["rmse", "track_loss"])
    print(as_markdown(table))
    return table


if __name__ == "__main__":
    run(main, Config)
