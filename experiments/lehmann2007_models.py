"""What S1 could not compare: all its motion models, learned parameters, and motion that switches.

python -m experiments.lehmann2007_models --workers 2
python -m experiments.lehmann2007_models --talkers '["natural", "continuous"]' --models '["CU-LAN", "CU-LAN-ORIG"]'

The ten models with the values of Table 1, those that have learned values with these too, and the chains of section 3.3
that S1 did not pursue, at both reverberation times and 20 dB. Prints a table, and the difference of every tracker from
the first on these recordings with its significance, paired by recording and seed.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

from experiments.command import run
from experiments.lehmann2007_recordings import Talker, recordings
from experiments.monte_carlo import METRICS, differences, done, trackers
from probtrack.dynamics import Lehmann2007Model
from probtrack.evaluation import Store, StudyFile
from probtrack.evaluation.rendering import as_markdown
from probtrack.evaluation.tables import StudyTable, tabulate
from probtrack.switching import PRESETS
from probtrack.trackers.lehmann2007 import learned_models

MODELS = ("CU-LAN", *(model for model in get_args(Lehmann2007Model) if model != "CU-LAN"), *PRESETS)


@dataclass(frozen=True)
class Config:
    """Track every recording 60 times with each model."""

    models: tuple[str, ...] = MODELS
    learned: bool = True  # the models that have learned parameters with these too
    talkers: tuple[Talker, ...] = ("natural",)
    speech: str | None = None  # folder of recorded talkers; synthetic ones by default
    num_particles: int = 75
    runs: int = 60
    workers: int = 2
    quick: bool = False  # two recordings, 4 runs
    name: str = "models"  # of the store
    out: Path = Path("build/lehmann2007")  # folder of the recordings and of the store


def main(config: Config) -> StudyTable:
    """Do the study, print it and return its table."""
    t60, ways, runs = ((0.27,), 2, 4) if config.quick else ((0.27, 0.34), 5, config.runs)
    scenes = [
        one
        for talker in config.talkers
        for t in t60
        for one in recordings(config.out, t, ways=ways, talker=talker, speech=config.speech)
    ]
    file = StudyFile(scenes=[*scenes], trackers=compared(config), metrics=METRICS, runs=runs)
    store = config.out / f"{config.name}{'-quick' if config.quick else ''}.sqlite"
    first, *others = file.trackers
    with Store(done(file, store, config.workers)) as study:
        table = tabulate(study, rows=["tracker"], columns=["talker", "t60"], metrics=METRICS)
        print(as_markdown(table))
        print(f"\n{differences(study, first, others, 'runs')}")
    return table


def compared(config: Config) -> dict[str, Any]:
    """Return the trackers of the study."""
    settings = {"num_particles": config.num_particles}
    printed = trackers(config.models, settings)
    if not config.learned:
        return printed
    models = [model for model in config.models if model in learned_models()]
    learned = trackers(models, {**settings, "parameters": "learned"})
    return printed | {f"{model}, learned": choice for model, choice in learned.items()}


if __name__ == "__main__":
    run(main, Config)
