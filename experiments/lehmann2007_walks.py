"""Which of S1's differences between models are no accident? Its six models on 20 walks instead of 5 ways.

python -m experiments.lehmann2007_walks --workers 2

The walks of `walks-test` (people who walk by social forces, pause and look about, at both reverberation times and four
levels of noise) with 10 runs each. Prints the models' figures, and how far CU-LAN is from every other, paired by
walk and seed: five ways cannot show a difference at the 5 % level, twenty can.
"""

from dataclasses import dataclass
from pathlib import Path

from experiments.command import run
from experiments.fit_scenes import data_set
from experiments.lehmann2007_recordings import MODELS
from experiments.monte_carlo import METRICS, differences, done, trackers
from probtrack.evaluation import Scenes, Store, StudyFile
from probtrack.evaluation.rendering import as_markdown
from probtrack.evaluation.tables import StudyTable, tabulate


@dataclass(frozen=True)
class Config:
    """Track every walk 10 times with each model."""

    vad_threshold: float = 2.0  # level over the noise that is taken for speech [dB]
    runs: int = 10
    workers: int = 2
    quick: bool = False  # two walks, 2 runs
    data: Path = Path("build/fit_scenes/data")  # folder of the data set, simulated if it is not there
    out: Path = Path("build/lehmann2007")  # folder of the store


def main(config: Config) -> StudyTable:
    """Do the study, print its table and the comparisons, and return the table."""
    folders = data_set("walks-test", config.data, quick=config.quick)
    file = StudyFile(
        scenes=[Scenes(str(folder.path.resolve()), f"walks-test/{folder.path.name}") for folder in folders],
        trackers=trackers(MODELS, {"num_particles": 75, "vad_threshold": config.vad_threshold}),
        metrics=METRICS,
        runs=2 if config.quick else config.runs,
    )
    path = config.out / f"walks-{config.vad_threshold:g}dB{'-quick' if config.quick else ''}.sqlite"
    with Store(done(file, path, config.workers)) as store:
        table = tabulate(store, rows=["tracker"], columns=["snr_db"], metrics=["rmse", "track_loss"])
        print(as_markdown(table))
        others = [model for model in MODELS if model != "CU-LAN"]
        print(f"\n{differences(store, 'CU-LAN', others, 'scenes')}")
    return table


if __name__ == "__main__":
    run(main, Config)
