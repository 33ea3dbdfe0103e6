"""S1's Table 2 again: six motion models at four levels of noise and two reverberation times.

python -m experiments.lehmann2007_table2 --workers 2
python -m experiments.lehmann2007_table2 --talker continuous

Five recordings of each condition and 60 runs of each model on each: 14 400 runs. Prints a table in S1's layout, each
figure with its interval and S1's own.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.command import run
from experiments.lehmann2007_recordings import MODELS, Talker, recordings
from experiments.monte_carlo import METRICS, done, trackers
from probtrack.evaluation import Store, StudyFile
from probtrack.evaluation.tables import StudyTable, tabulate

SNR_DB = (5.0, 10.0, 15.0, 20.0)
T60 = (0.27, 0.34)

PRINTED: dict[tuple[float, float], dict[str, tuple[float, float]]] = {
    (5.0, 0.27): {
        "CU-LAN-ORIG": (0.127, 11.2), "CU-LAN": (0.063, 11.2), "CU-RWVE": (0.082, 18.3), "CU-TCVE": (0.099, 34.6),
        "CU-TCAC": (0.070, 12.9), "CL-RWVE-RAAC": (0.118, 40.8),
    },
    (5.0, 0.34): {
        "CU-LAN-ORIG": (0.232, 88.7), "CU-LAN": (0.104, 38.7), "CU-RWVE": (0.199, 62.3), "CU-TCVE": (0.284, 69.0),
        "CU-TCAC": (0.128, 46.0), "CL-RWVE-RAAC": (0.359, 82.7),
    },
    (10.0, 0.27): {
        "CU-LAN-ORIG": (0.094, 0.0), "CU-LAN": (0.040, 1.7), "CU-RWVE": (0.047, 8.3), "CU-TCVE": (0.054, 9.2),
        "CU-TCAC": (0.042, 2.1), "CL-RWVE-RAAC": (0.063, 27.1),
    },
    (10.0, 0.34): {
        "CU-LAN-ORIG": (0.140, 58.0), "CU-LAN": (0.070, 22.0), "CU-RWVE": (0.098, 36.7), "CU-TCVE": (0.180, 50.0),
        "CU-TCAC": (0.073, 23.3), "CL-RWVE-RAAC": (0.233, 61.7),
    },
    (15.0, 0.27): {
        "CU-LAN-ORIG": (0.077, 0.0), "CU-LAN": (0.029, 0.4), "CU-RWVE": (0.034, 2.5), "CU-TCVE": (0.040, 7.5),
        "CU-TCAC": (0.031, 0.8), "CL-RWVE-RAAC": (0.048, 15.0),
    },
    (15.0, 0.34): {
        "CU-LAN-ORIG": (0.113, 40.3), "CU-LAN": (0.052, 19.0), "CU-RWVE": (0.073, 22.0), "CU-TCVE": (0.090, 31.0),
        "CU-TCAC": (0.060, 14.3), "CL-RWVE-RAAC": (0.179, 52.7),
    },
    (20.0, 0.27): {
        "CU-LAN-ORIG": (0.068, 4.6), "CU-LAN": (0.027, 0.0), "CU-RWVE": (0.033, 1.2), "CU-TCVE": (0.036, 5.8),
        "CU-TCAC": (0.028, 0.8), "CL-RWVE-RAAC": (0.039, 12.5),
    },
    (20.0, 0.34): {
        "CU-LAN-ORIG": (0.100, 33.3), "CU-LAN": (0.045, 19.3), "CU-RWVE": (0.059, 19.7), "CU-TCVE": (0.070, 22.0),
        "CU-TCAC": (0.049, 11.3), "CL-RWVE-RAAC": (0.106, 43.7),
    },
}  # fmt: skip
"""S1's mean RMSE [m] and track loss [%] by SNR [dB] and T60 [s]."""


@dataclass(frozen=True)
class Config:
    """Track every recording 60 times with each model."""

    talker: Talker = "natural"
    vad_threshold: float = 8.0  # level over the noise that is taken for speech [dB]; S1 does not say its detector's
    runs: int = 60
    workers: int = 2
    quick: bool = False  # two recordings of two conditions, 4 runs
    out: Path = Path("build/lehmann2007")  # folder of the recordings and of the store


def main(config: Config) -> StudyTable:
    """Do the study, print its table and return it."""
    snr_db, t60, ways, runs = (SNR_DB[-2:], T60[:1], 2, 4) if config.quick else (SNR_DB, T60, 5, config.runs)
    scenes = [one for t in t60 for one in recordings(config.out, t, snr_db, ways=ways, talker=config.talker)]
    file = StudyFile(
        scenes=[*scenes],
        trackers=trackers(MODELS, {"num_particles": 75, "vad_threshold": config.vad_threshold}),
        metrics=METRICS,
        runs=runs,
    )
    name = f"table2-{config.talker}-{config.vad_threshold:g}dB{'-quick' if config.quick else ''}.sqlite"
    with Store(done(file, config.out / name, config.workers)) as store:
        table = tabulate(store, rows=["tracker"], columns=["snr_db", "t60"], metrics=["rmse", "track_loss"])
    print(beside(table))
    print(f"\nS1's figure lies in {agreeing(table)} of {table.value.size} intervals")
    return table


def agreeing(table: StudyTable) -> int:
    """Return how many of S1's figures lie in the interval of ours."""
    printed = np.array([[PRINTED[c["snr_db"], c["t60"]][row["tracker"]] for c in table.columns] for row in table.rows])
    return int(((table.low <= printed) & (printed <= table.high)).sum())


def beside(table: StudyTable) -> str:
    """Return the table in Markdown, a figure as `ours [interval] (S1's)`."""
    conditions = [(c["snr_db"], c["t60"]) for c in table.columns]
    heads = [f"{snr:g} dB, {t60:g} s" for snr, t60 in conditions]
    lines = ["| model | | " + " | ".join(heads) + " |", "|---|---|" + "---|" * len(heads)]
    for i, row in enumerate(table.rows):
        model = row["tracker"]
        for j, (name, digits) in enumerate((("RMSE [m]", 3), ("track loss [%]", 1))):
            cells = [
                f"{table.value[i, c, j]:.{digits}f} [{table.low[i, c, j]:.{digits}f}, {table.high[i, c, j]:.{digits}f}]"
                f" ({PRINTED[condition][model][j]:g})"
                for c, condition in enumerate(conditions)
            ]
            lines.append(f"| {model if j == 0 else ''} | {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


if __name__ == "__main__":
    run(main, Config)
