"""Scenes that are made in a moment: without reflections, or with few, and two microphones."""

import dataclasses

from probtrack.simulation import Scene
from probtrack.simulation.rooms import ShoeboxRoom
from probtrack.simulation.trajectories import FacingPoint, GivenPaths, Standing, Through
from probtrack.simulation.voices import SyntheticVoices

SIZE = (3.5, 3.1, 2.2)
OPEN = ShoeboxRoom(SIZE, 0.0)
HARD = ShoeboxRoom(SIZE, 0.08, spacing=0.5)
WALK = Through(((0.9, 2.3, 1.5), (1.3, 1.1, 1.4), (2.4, 1.3, 1.6)))
TWO = GivenPaths((FacingPoint(WALK, (2.6, 2.2)), Standing((2.3, 2.1, 1.3), 0.4)))  # one looks about as it walks


def quick(**changes):
    return dataclasses.replace(
        Scene(2.0, OPEN, GivenPaths((WALK,)), SyntheticVoices(), array="klaassen2005", seed=3), **changes
    )


def two_talkers(**changes):
    return quick(trajectories=TWO, num_talkers=2, **changes)


TEMPLATE = """duration: 1.7
room: {class_path: ShoeboxRoom, init_args: {size: [3.5, 3.1, 2.2], t60: 0.0}}
trajectories: {class_path: probtrack.simulation.trajectories.lehmann2007_way, init_args: {number: 2}}
voices: {class_path: SyntheticVoices}
array: pair.yaml
"""
"""A scene file; its array is beside it."""

ARRAY = "name: pair\npositions: [[0.4, 0.5, 1.3], [0.7, 0.5, 1.4]]\n"


def write_scene(folder, text=TEMPLATE):
    """Write a scene file and its array, and return its path as text."""
    (folder / "pair.yaml").write_text(ARRAY)
    (folder / "mine.yaml").write_text(text)
    return str(folder / "mine.yaml")


def write_data_set(folder, *lines, template=TEMPLATE):
    """Write a data set file with one template, and return its path as text."""
    inner = "\n".join("    " + line for line in template.splitlines())
    return write_scene(folder, "\n".join([*lines, "scenes:", "  -" + inner[3:]]) + "\n")
