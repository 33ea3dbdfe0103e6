"""Monte-Carlo studies: trackers on recordings, many runs each, kept in a file that grows cell by cell.

What needs torch is imported when it is first named: tables and pictures of a finished study do without.
"""

import importlib
from typing import TYPE_CHECKING

from probtrack.evaluation.comparison import Comparison as Comparison
from probtrack.evaluation.comparison import compare as compare
from probtrack.evaluation.export import export_runs as export_runs
from probtrack.evaluation.export import runs_table as runs_table
from probtrack.evaluation.pairing import Side as Side
from probtrack.evaluation.pictures import plot_study as plot_study
from probtrack.evaluation.store import CellScores as CellScores
from probtrack.evaluation.store import PlannedCell as PlannedCell
from probtrack.evaluation.store import PlannedScene as PlannedScene
from probtrack.evaluation.store import Scores as Scores
from probtrack.evaluation.store import Store as Store
from probtrack.evaluation.store import StoredCell as StoredCell
from probtrack.evaluation.tables import Completion as Completion
from probtrack.evaluation.tables import StudyTable as StudyTable
from probtrack.evaluation.tables import tabulate as tabulate

if TYPE_CHECKING:
    from probtrack.evaluation.cell import Cell as Cell
    from probtrack.evaluation.choices import Choice as Choice
    from probtrack.evaluation.recordings import Scenes as Scenes
    from probtrack.evaluation.run import Progress as Progress
    from probtrack.evaluation.run import evaluate as evaluate
    from probtrack.evaluation.study import Study as Study
    from probtrack.evaluation.study import StudyFile as StudyFile
    from probtrack.evaluation.study import load_study as load_study
    from probtrack.evaluation.study import plan as plan

_WITH_TORCH = {
    "Cell": "cell", "Progress": "run", "evaluate": "run", "Scenes": "recordings", "Choice": "choices",
    "Study": "study", "StudyFile": "study", "load_study": "study", "plan": "study",
}  # fmt: skip


def __getattr__(name: str) -> object:
    if name in _WITH_TORCH:
        return getattr(importlib.import_module(f"probtrack.evaluation.{_WITH_TORCH[name]}"), name)
    raise AttributeError(f"module 'probtrack.evaluation' has no attribute {name!r}")
