"""Scenes and data sets that ship with probtrack: the rooms of the papers."""

import dataclasses
from importlib import resources
from pathlib import Path

from probtrack.errors import InputError
from probtrack.simulation.scene_folder import load_scene
from probtrack.simulation.scenes import Scene
from probtrack.simulation.voices import RecordedVoices


def shipped_scenes() -> dict[str, Path]:
    """Return the scene and data set files that ship with probtrack, by name."""
    folder = Path(str(resources.files("probtrack") / "scenes"))
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def preset(name: str) -> Scene:
    """Return a scene that ships with probtrack.

    >>> preset("lehmann2007").room.t60
    0.27
    """
    known = shipped_scenes()
    if name not in known:
        raise InputError(f"scene must be one of {', '.join(known)}, got {name!r}")
    return load_scene(known[name])


def demo_scene(seed: int = 0, speech: str | None = None) -> Scene:
    """Return a walk of 8 s among the eight microphones of Lehmann & Johansson 2007, at their height.

    The room is theirs (3.5 x 3.1 x 2.2 m, T60 0.27 s), at 20 dB. Their Figure 3 shows one bent line across the
    array, walked in 7.8 s: so is this one, 2.2 m long; the talker pauses on the way.

    Args:
        seed: Of what is said and of the noise.
        speech: Audio file, or folder, with a voice to use; None for a synthetic one.
    """
    scene = dataclasses.replace(preset("lehmann2007"), seed=seed)
    return scene if speech is None else dataclasses.replace(scene, voices=RecordedVoices(speech))
