"""S1's five ways through its room, simulated: what its Table 2 and Figure 6 are asked of again."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from probtrack.evaluation import Scenes
from probtrack.simulation import DataSet, make_data_set, preset
from probtrack.simulation.rooms import default_cache
from probtrack.simulation.trajectories import lehmann2007_way
from probtrack.simulation.voices import GivenTurns, RecordedVoices, SyntheticVoices, TurnTaking

Talker = Literal["natural", "omnidirectional", "fluent", "continuous"]
"""Who pauses as people do, and is heard less from behind; only pauses; is only heard less from behind; neither."""

_PAUSES, _DIRECTIONAL = ("natural", "omnidirectional"), ("natural", "fluent")

PRESETS = {0.27: "lehmann2007", 0.34: "lehmann2007-t60-0.34"}
SNR_DB = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0)
MODELS = ("CU-LAN-ORIG", "CU-LAN", "CU-RWVE", "CU-TCVE", "CU-TCAC", "CL-RWVE-RAAC")
"""Those that S1 judged fit, and the older values of the Langevin model beside them."""


def recordings(
    folder: Path,
    t60: float,
    snr_db: Sequence[float] = (20.0,),
    *,
    ways: int = 5,
    talker: Talker = "natural",
    speech: str | None = None,
    seed: int = 0,
) -> list[Scenes]:
    """Return the recordings of the first `ways` at one reverberation time [s], simulated if they are not there."""
    base = dataclasses.replace(
        preset(PRESETS[t60]),
        voices=SyntheticVoices() if speech is None else RecordedVoices(speech),
        turns=TurnTaking() if talker in _PAUSES else GivenTurns(((0, 0.2, 8.0),)),
        directivity="speech" if talker in _DIRECTIONAL else "omnidirectional",
    )
    templates = tuple(dataclasses.replace(base, trajectories=lehmann2007_way(n)) for n in range(1, ways + 1))
    data_set = DataSet(templates, count=ways, snr_db=SNR_DB, seed=seed)
    name = f"{talker}-{t60:g}" + ("" if speech is None else "-recorded")
    path = folder / f"{name}-{ways}-{seed}"
    for _ in make_data_set(data_set, path, default_cache(), workers=os.cpu_count() or 1):
        pass
    wanted = [data_set.recordings(i) for i in range(ways)]
    return [
        Scenes(
            str((path / row).resolve()),
            f"{name}/{row}",
            {"talker": talker if speech is None else f"{talker}, recorded"},
        )
        for rows in wanted
        for row, scene in rows.items()
        if scene.snr_db in snr_db
    ]
