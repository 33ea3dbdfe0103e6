"""Scene files: every part goes to YAML and comes back, and what is wrong with one is said in one line."""

import dataclasses
import sys

import pytest
import yaml
from quick_scenes import TEMPLATE, quick, write_scene
from test_measured_rooms import folder

from probtrack.errors import InputError
from probtrack.simulation import DataSet, Faults, Scene, load_data_set, load_scene, preset, shipped_scenes
from probtrack.simulation.description import described, from_description
from probtrack.simulation.noise import DiffuseNoise, Interferer, RecordedNoise, WhiteNoise
from probtrack.simulation.rooms import ShoeboxRoom
from probtrack.simulation.rooms.measured import MeasuredRoom
from probtrack.simulation.trajectories import (
    Arc,
    FacingPoint,
    GivenPaths,
    InTurn,
    ModelWalk,
    SmoothPaths,
    SocialForceWalk,
    Standing,
    Through,
    Turning,
    TurningTo,
    Waiting,
    lehmann2007_way,
)
from probtrack.simulation.voices import GivenTurns, RecordedVoices, SyntheticVoice, SyntheticVoices, TurnTaking

PLACE = (1.1, 0.7, 1.5)
STANDING = Standing(PLACE, 0.3)
WAYS = (
    Through((PLACE, (2.0, 1.0, 1.4)), 0.5),
    Arc(PLACE, 0.4, 0.1, 1.5, ramp=0.6),
    Turning(STANDING, 0.2, 0.5),
    TurningTo(STANDING, 0.2, 0.9, 0.4),
    FacingPoint(STANDING, (0.3, 0.2)),
    InTurn((STANDING, Waiting(STANDING, 0.1, 0.2)), (0.3, 0.7)),
)
PARTS = [
    *({"trajectories": GivenPaths((way,))} for way in WAYS),
    {"trajectories": SmoothPaths(((PLACE, (2.0, 1.0, 1.4)),), 0.7)},
    {"trajectories": ModelWalk("CU-TCVE", speed=0.4, height=1.5)},
    {"trajectories": SocialForceWalk(speed=1.1, address=(1.0, 2.0))},
    {"room": ShoeboxRoom((3.0, 3.5, 2.1), 0.23, 0.2, 340.5)},
    {"voices": SyntheticVoices((SyntheticVoice(pitch=201.5, rate=3.3),))},
    {"voices": RecordedVoices("somewhere", ("anne", "yes", "1"))},
    {"turns": TurnTaking(overlap=0.25, gap=1e-5)},
    {"turns": GivenTurns(((0, 0.25, 1.125),))},
    {"noises": (WhiteNoise(-3.0), Interferer(PLACE, spectrum="pink"), DiffuseNoise(cylindrical=True))},
    {"noises": (RecordedNoise("noise.wav"),)},
    {"noises": ()},
    {"faults": Faults(0.5, 0.01, (2, 1), 6.0), "directivity": "omnidirectional", "fs": 44100, "seed": 2**60},
]


def through_yaml(value):
    return yaml.safe_load(yaml.safe_dump(described(value), sort_keys=False, default_flow_style=None))


@pytest.mark.parametrize("parts", PARTS, ids=str)
def test_every_part_comes_back(parts):
    scene = quick(**parts)
    back = from_description(Scene, through_yaml(scene), "there")
    assert back == scene
    assert hash(back) == hash(scene)
    assert isinstance(back.noises, tuple)


@pytest.mark.parametrize("name", [name for name in shipped_scenes() if not name.startswith("walks")])
def test_every_preset_comes_back(name):
    scene = preset(name)
    assert from_description(Scene, through_yaml(scene), "there") == scene


def test_data_set_comes_back():
    made = load_data_set(shipped_scenes()["walks"])
    assert made.count == 100
    assert from_description(DataSet, through_yaml(made), "there") == made
    mixed = DataSet((quick(), preset("fallon2006")), 7, (5.0, -2.5), 3)
    assert from_description(DataSet, through_yaml(mixed), "there") == mixed


def test_measured_room_comes_back(tmp_path):
    room = MeasuredRoom(folder(tmp_path), None, 0.5, 0.25)
    scene = quick(room=room)
    back = from_description(Scene, through_yaml(scene), "there")
    assert back == scene
    assert back.room.array.num_microphones == 4


def test_integers_are_lengths_and_short_names_are_enough(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_text("duration: 2\nroom: {class_path: ShoeboxRoom, init_args: {size: [3, 3.5, 2], t60: 1e-1}}\n"
                    "trajectories: {class_path: SocialForceWalk}\nvoices: SyntheticVoices\n")  # fmt: skip
    scene = load_scene(path)
    assert scene == Scene(2.0, ShoeboxRoom((3.0, 3.5, 2.0), 0.1), SocialForceWalk(), SyntheticVoices())
    assert isinstance(scene.duration, float)


def test_a_function_is_read_as_what_it_returns(tmp_path):
    path = tmp_path / "scene.yaml"
    path.write_text(TEMPLATE)
    scene = load_scene(path)
    assert scene.trajectories == lehmann2007_way(2)
    assert from_description(Scene, through_yaml(scene), "there") == scene


OWN = """
from dataclasses import dataclass

from probtrack.simulation.motion import Motion
from probtrack.simulation.trajectories import GivenPaths, Standing, Trajectories


@dataclass(frozen=True)
class Statue(Trajectories):
    place: tuple[float, float, float]

    def draw(self, seeds, **given) -> Motion:
        return GivenPaths((Standing(self.place),)).draw(seeds, **given)
"""


def test_a_class_of_ones_own_needs_no_registry(tmp_path, monkeypatch):
    (tmp_path / "own_statue.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    own = "trajectories: {class_path: own_statue.Statue, init_args: {place: [1, 2, 1.5]}}"
    text = "\n".join(own if line.startswith("traj") else line for line in TEMPLATE.splitlines())
    scene = load_scene(write_scene(tmp_path, text))
    assert type(scene.trajectories) is sys.modules["own_statue"].Statue
    assert described(scene)["trajectories"]["class_path"] == "own_statue.Statue"
    assert from_description(Scene, through_yaml(scene), "there") == scene
    assert scene.motion().position[0, 0].tolist() == [1.0, 2.0, 1.5]
    monkeypatch.delitem(sys.modules, "own_statue")


def test_what_yaml_cannot_say_is_refused():
    @dataclasses.dataclass(frozen=True)
    class Odd:
        what: object

    with pytest.raises(InputError, match="cannot say a set"):
        described(Odd({1}))


def changed(**lines):
    """Return the template with some of its lines, by their first word, in other words."""
    kept = [line for line in TEMPLATE.splitlines() if line.split(":")[0] not in lines]
    return "\n".join([*kept, *(f"{name}: {text}" for name, text in lines.items() if text is not None)]) + "\n"


ROOM = "{class_path: ShoeboxRoom, init_args: {size: [3.0, 3.0, 3.0], %s}}"
WRONG = {
    "unknown class": (changed(room="{class_path: Shoebox}"), "room: expected the import path of a class, got Shoebox"),
    "unknown module": (changed(room="{class_path: foo.Baz}"), "room: Baz: No module named 'foo'"),
    "not in a module": (changed(room="{class_path: math.Room}"), "room: Room: module 'math' has no attribute 'Room'"),
    "of another family": (changed(room="{class_path: json.loads}"), "room: .*json.loads .* subclass of Room"),
    "abstract": (changed(room="{class_path: Room}"), "room: .*Room is abstract"),
    "a number": (changed(room="3"), "room: .* Got value: 3"),
    "unknown argument": (changed(colour="red"), "nothing is called 'colour'"),
    "unknown below": (changed(room=ROOM % "t60: 0, t: 1"), "room: ShoeboxRoom: nothing is called 't'"),
    "unknown fault": (changed(faults="{gain: 1}"), "nothing is called 'faults.gain'"),
    "missing": (changed(voices=None), "the following arguments are required: voices"),
    "missing below": (changed(room=ROOM % "spacing: 1"), "room: ShoeboxRoom: the following .* required: t60"),
    "too short": (changed(room=ROOM.replace("3.0, 3", "3") % "t60: 0"), "size: expected tuple with 3 elements"),
    "type": (changed(duration="long"), "duration: expected float, got long"),
    "bool": (changed(duration="true"), "duration: expected float, got True"),
    "half": (changed(seed="1.5"), "seed: expected int, got 1.5"),
    "type below": (changed(room=ROOM % "t60: dry"), "room: ShoeboxRoom: t60: expected float, got dry"),
    "optional": (changed(faults="{clipping_db: soft}"), "faults.clipping_db: expected float or null, got soft"),
    "value": (changed(duration="-1"), "scene: duration must be 0.032 to .* s, got -1.0"),
    "value below": (changed(room=ROOM % "t60: -1"), "room: t60 must be finite and not negative, got -1.0"),
    "choice": (changed(directivity="loud"), "directivity: expected one of 'speech', 'omnidirectional', got 'loud'"),
    "no list": (changed(noises="{class_path: WhiteNoise}"), "noises: expected tuple, got"),
    "in a list": (changed(noises="[white]"), "noises: expected the import path of a class, got white"),
    "deep": (
        changed(trajectories="{class_path: GivenPaths, init_args: {ways: [{class_path: Standing}]}}"),
        "trajectories: GivenPaths: ways: Standing: the following arguments are required: point",
    ),
    "empty": ("", "must be a YAML mapping, got NoneType"),
    "list": ("- 1", "must be a YAML mapping, got list"),
    "numbered": (changed() + "3: 4\n", "Key must be a string, got: 3"),
    "broken": ("a: [", "scene file is not YAML"),
    "code": (changed(seed="!!python/name:os.system"), "scene file is not YAML"),
    "bytes": ("\x00", "scene file is not YAML"),
    "date": (changed(duration="2001-99-01"), "scene file is not YAML: month must be"),
}


@pytest.mark.parametrize(("text", "message"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_said_in_one_line(tmp_path, text, message):
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=message) as caught:
        load_scene(path)
    said = str(caught.value)
    assert said.startswith(f"{path}: ")
    assert "\n" not in said
    assert len(said) < len(str(path)) + 220


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match=r"none.yaml: cannot read scene file: No such file"):
        load_scene(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ({"count": "0"}, "count must be an integer of at least 1, got 0"),
        ({"count": "2", "snr_db": "5"}, r"snr_db: expected tuple\[float, ...\] or null, got 5"),
        ({"count": "2", "snr_db": "[5, 5.0]"}, "snr_db must be different ratios"),
        ({"count": "2", "snr_db": "[]"}, "snr_db must be different ratios, at least one"),
        ({"count": "2", "scenes": "[]"}, "scenes must hold at least one template"),
        ({"count": "2", "scenes": "[lehmann2007]"}, "scenes: expected the import path of a class, got lehmann2007"),
        ({"count": "2", "scenes": "[{duratoin: 2.0}]"}, "scenes: Scene: nothing is called 'duratoin'"),
        ({"scenes": "[]"}, "the following arguments are required: count"),
    ],
)
def test_what_is_wrong_with_a_data_set_is_said_in_one_line(tmp_path, lines, message):
    path = tmp_path / "set.yaml"
    inner = TEMPLATE.replace("\n", "\n    ").rstrip()
    text = {"scenes": "\n  - " + inner} | lines
    path.write_text("".join(f"{name}: {value}\n" for name, value in text.items()))
    with pytest.raises(InputError, match=message) as caught:
        load_data_set(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
