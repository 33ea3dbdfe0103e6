"""Rooms of measured impulse responses, from folders and SOFA files written here, and real ones."""

import builtins
import math

import pytest
import soundfile
import torch

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation.motion import Motion
from probtrack.simulation.rooms.measured import MeasuredRoom

FS = 16000
PLACES = torch.tensor([[1.2, 0.4, 0.7], [1.1, 0.9, 0.7], [0.8, 1.6, 0.7]], dtype=torch.float64)
MICROPHONES = torch.tensor([[0.0, 0.0, 0.7], [0.05, 0.2, 0.7], [-0.1, 0.4, 0.7], [0.0, 0.6, 0.7]], dtype=torch.float64)


def travel(places, microphones, fs):
    return torch.linalg.vector_norm(places[:, None] - microphones, dim=-1) / 343 * fs


def pulses(fs, places=PLACES, microphones=MICROPHONES, size=400):
    """Direct sound alone (K, M, size): band-limited pulses of height 1 / distance, low-passed to 4 kHz."""
    late = torch.arange(size) - travel(places, microphones, fs)[..., None]
    width = 8000 / fs
    window = torch.cos(torch.pi / 2 * (late / 60).clamp(-1, 1)) ** 2
    return width * torch.sinc(width * late) * window / travel(places, microphones, 343.0)[..., None]


def folder(path, fs=FS, axes=3, **changes):
    """Write a folder of responses; names sort by number only, not as text."""
    responses = pulses(fs) if "responses" not in changes else changes["responses"]
    for k, response in enumerate(responses):
        soundfile.write(path / f"place_{k + 9}.wav", response.T.numpy(), fs, subtype="FLOAT")
    rows = [",".join(("x_m", "y_m", "z_m")[:axes])] + [",".join(map(str, row[:axes])) for row in PLACES.tolist()]
    (path / "places.csv").write_text("\n".join(rows) + "\n")
    MicrophoneArray(MICROPHONES[:, :axes]).to_yaml(path / "array.yaml")
    return str(path)


def at(positions):
    angle = torch.zeros(len(positions))
    return Motion(positions, torch.zeros_like(positions), angle, angle)


def standing(place, size):
    return at(torch.as_tensor(place, dtype=torch.float64).expand(size, 3))


def spectrum(response):
    return torch.fft.rfft(response)[..., 40:128]  # of 640 samples at 16 kHz: 1 to 3.2 kHz


def test_a_folder_tells_places_microphones_and_rate(tmp_path):
    room = MeasuredRoom(folder(tmp_path, 48000))
    torch.testing.assert_close(room.positions, PLACES)
    torch.testing.assert_close(room.array.positions, MICROPHONES)
    assert room.fs == 48000
    assert room.region.contains(PLACES).all()


def test_height_completes_positions_in_a_plane(tmp_path):
    room = MeasuredRoom(folder(tmp_path, axes=2), height=0.7)
    torch.testing.assert_close(room.positions, PLACES)
    torch.testing.assert_close(room.array.positions, MICROPHONES)


@pytest.mark.parametrize("measured_at", [16000, 48000, 44100, 8000])
@pytest.mark.parametrize("place", [0, 2])
def test_a_pulse_is_heard_as_measured_at_any_rate(tmp_path, measured_at, place):
    room = MeasuredRoom(folder(tmp_path, measured_at))
    x = torch.zeros(640)
    x[0] = 1.0
    heard = room.render(x, standing(PLACES[place] + 0.05, 640), room.array, FS)
    delay, distance = (travel(PLACES, MICROPHONES, rate)[place, :, None] for rate in (FS, 343.0))
    bins = torch.arange(40, 128)
    expected = torch.exp(-2j * torch.pi * bins * delay / 640) / distance
    torch.testing.assert_close(spectrum(heard), expected, rtol=0.01, atol=0.01)


def test_a_walk_goes_from_place_to_nearest_place(tmp_path):
    room = MeasuredRoom(folder(tmp_path), reach=0.5)
    signal, share = torch.randn(FS), torch.linspace(0, 1, FS)[:, None]
    walk = at(PLACES[0] + share * (PLACES[1] - PLACES[0]))
    heard = room.render(signal, walk, room.array, FS)
    first, second = (room.render(signal, standing(PLACES[k], FS), room.array, FS) for k in (0, 1))
    torch.testing.assert_close(heard[:, : FS // 2 - 400], first[:, : FS // 2 - 400])
    torch.testing.assert_close(heard[:, FS // 2 + 800 :], second[:, FS // 2 + 800 :])
    assert not torch.allclose(first, second)


def test_the_mouth_and_its_directivity_play_no_part(tmp_path):
    room, x = MeasuredRoom(folder(tmp_path)), torch.randn(900)
    one = standing(PLACES[1], 900)
    turned = one._replace(mouth=one.mouth + 2.0)
    assert torch.equal(room.render(x, one, room.array, FS), room.render(x, turned, room.array, FS))


def test_who_is_too_far_from_all_places_is_told(tmp_path):
    room = MeasuredRoom(folder(tmp_path), reach=0.25)
    path = torch.stack(
        [PLACES[0], PLACES[0] - torch.tensor([0.2, 0.0, 0.0]), PLACES[0] - torch.tensor([0.3, 0.0, 0.0])]
    )
    message = r"a source at \(0.9, 0.4, 0.7\) m is 0.30 m from the nearest measured place, \(1.2, 0.4, 0.7\) m"
    with pytest.raises(InputError, match=message):
        room.render(torch.ones(3), at(path), room.array, FS)
    room.render(torch.ones(2), at(path[:2]), room.array, FS)


def test_other_microphones_are_refused(tmp_path):
    room = MeasuredRoom(folder(tmp_path))
    moved = MICROPHONES.clone()
    moved[2, 1] += 0.002
    with pytest.raises(InputError, match=r"measured with microphone 3 at \(-0.1, 0.4, 0.7\) m and hold for no other"):
        room.render(torch.ones(9), standing(PLACES[0], 9), MicrophoneArray(moved), FS)
    with pytest.raises(InputError, match="measured with 4 microphones on 3 axes, got 3 on 3"):
        room.render(torch.ones(9), standing(PLACES[0], 9), MicrophoneArray(moved[:3]), FS)


def sofa(path, responses, sources, *, kind="cartesian", receivers=None, rate=FS, **more):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file["Data.IR"], file["Data.SamplingRate"] = responses.numpy(), [float(rate)]
        file["SourcePosition"] = sources.numpy()
        file["SourcePosition"].attrs["Type"] = kind.encode()
        if receivers is not None:
            file["ReceiverPosition"] = receivers.numpy()[..., None]
        for name, values in more.items():
            file[name.replace("_", ".")] = values
    return str(path)


def test_a_sofa_file_tells_the_same_as_a_folder(tmp_path):
    file = sofa(tmp_path / "r.sofa", pulses(FS), PLACES, receivers=MICROPHONES)
    room, same = MeasuredRoom(file), MeasuredRoom(folder(tmp_path))
    torch.testing.assert_close(room.positions, PLACES)
    x = torch.randn(2000)
    heard, expected = (r.render(x, standing(PLACES[1], 2000), r.array, FS) for r in (room, same))
    torch.testing.assert_close(heard, expected, rtol=0, atol=1e-5)


def test_spherical_sources_and_ears_of_a_turned_head(tmp_path):
    turn, where = math.radians(30), torch.tensor([0.5, -0.2, 1.0], dtype=torch.float64)
    angles = torch.tensor([[40.0, 20.0, 2.0], [200.0, -10.0, 1.5]], dtype=torch.float64)
    places = torch.tensor([[1.43969, 1.20805, 0.68404], [-1.38815, -0.50525, -0.26047]], dtype=torch.float64)
    ears = torch.tensor([[-0.09 * math.sin(turn), 0.09 * math.cos(turn), 0.0]]) * torch.tensor([[1.0], [-1.0]]) + where
    view = {"ListenerPosition": where.numpy()[None], "ListenerView": [[math.cos(turn), math.sin(turn), 0.0]]}
    file = sofa(tmp_path / "h.sofa", pulses(FS, places, ears), angles, kind="spherical", **view)
    room = MeasuredRoom(file)
    torch.testing.assert_close(room.positions, places, rtol=0, atol=1e-4)
    torch.testing.assert_close(room.array.positions, ears)


def test_clockwise_azimuths_are_found_out_and_can_be_turned_round(tmp_path):
    mirrored = PLACES * torch.tensor([1.0, -1.0, 1.0])
    line = torch.tensor([[0.0, 0.3, 0.7], [0.0, 0.0, 0.7], [0.0, -0.3, 0.7]], dtype=torch.float64)
    file = sofa(tmp_path / "m.sofa", pulses(FS, PLACES, line), mirrored, receivers=line)
    with pytest.raises(InputError, match="responses contradict the positions"):
        MeasuredRoom(file).positions.sum()
    torch.testing.assert_close(MeasuredRoom(file, clockwise=True).positions, PLACES)


@pytest.mark.parametrize("delay", [[[30.0, 30.0, 30.0, 30.0]], [[30.25, 31.5, 30.0, 29.0]]])
def test_delays_beside_the_responses_count(tmp_path, delay):
    early = pulses(FS, size=250)
    file = sofa(tmp_path / "d.sofa", early, PLACES, receivers=MICROPHONES, Data_Delay=delay)
    x = torch.zeros(640)
    x[0] = 1.0
    heard = MeasuredRoom(file).render(x, standing(PLACES[0], 640), MeasuredRoom(file).array, FS)
    shift = torch.exp(-2j * torch.pi * torch.arange(40, 128) * torch.tensor(delay[0])[:, None] / 640)
    expected = spectrum(torch.nn.functional.pad(early[0], (0, 390))) * shift
    torch.testing.assert_close(spectrum(heard), expected, rtol=0, atol=1e-3)


def test_sofa_files_without_h5py_name_the_extra(tmp_path, monkeypatch):
    real = builtins.__import__

    def absent(name, *args, **kwargs):
        if name == "h5py":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    (tmp_path / "r.sofa").write_bytes(b"")
    monkeypatch.setattr(builtins, "__import__", absent)
    with pytest.raises(ImportError, match=r"pip install 'probtrack\[simulation\]'"):
        MeasuredRoom(str(tmp_path / "r.sofa")).positions.sum()


def test_files_that_cannot_be_used_are_said(tmp_path):
    pytest.importorskip("h5py")
    (tmp_path / "text.sofa").write_text("no HDF5")
    good = {"receivers": MICROPHONES}
    turning = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    cases = [
        (str(tmp_path / "none.sofa"), "there is no such SOFA file or folder"),
        (str(tmp_path / "text.sofa"), "cannot read SOFA file"),
        (sofa(tmp_path / "a", pulses(FS)[0], PLACES, **good), "Data.IR must have shape"),
        (sofa(tmp_path / "b", pulses(FS), PLACES, kind="polar", **good), "must be cartesian or spherical, got polar"),
        (sofa(tmp_path / "c", pulses(FS), PLACES, receivers=MICROPHONES[:2]), "ReceiverPosition must have 4 rows"),
        (sofa(tmp_path / "d", pulses(FS), PLACES, ListenerView=turning, **good), "ListenerView must be the same"),
        (sofa(tmp_path / "e", pulses(FS) * torch.nan, PLACES, **good), "responses must be finite"),
        (sofa(tmp_path / "f", pulses(FS), PLACES * torch.nan, **good), "source positions must be finite"),
    ]
    for path, message in cases:
        with pytest.raises(InputError, match=message) as caught:
            MeasuredRoom(path).positions.sum()
        assert path in str(caught.value)
        assert "\n" not in str(caught.value)


def test_folders_that_cannot_be_used_are_said(tmp_path):
    def said(message):
        with pytest.raises(InputError, match=message):
            MeasuredRoom(str(tmp_path)).positions.sum()

    said("holds no WAV files")
    silent = pulses(FS)
    silent[1, 2] = 0
    folder(tmp_path, responses=silent)
    said("the response from place 2 to microphone 3 is silent")
    folder(tmp_path, responses=pulses(FS)[:, :3])
    said("must have a channel for each of 4 microphones, got 3")
    folder(tmp_path)
    soundfile.write(tmp_path / "place_30.wav", torch.ones(9, 4).numpy(), FS)
    said("a position for each of 4 WAV files, got 3")
    (tmp_path / "places.csv").write_text("x,y\n1,2\n")
    said("must have columns x_m, y_m")
    (tmp_path / "more.csv").write_text("")
    said("must hold one CSV file of source positions, got 2")


def test_settings_that_cannot_be_are_said(tmp_path):
    with pytest.raises(InputError, match="reach must be finite and positive, got 0"):
        MeasuredRoom(str(tmp_path), reach=0.0)
    with pytest.raises(InputError, match="height must be finite, got nan"):
        MeasuredRoom(str(tmp_path), height=math.nan)
    with pytest.raises(InputError, match="clockwise goes with a SOFA file"):
        MeasuredRoom(str(tmp_path), clockwise=True)


@pytest.mark.realdata
def test_a_measured_line_array_hears_sources_where_they_are(data_dir, tmp_path):
    MicrophoneArray([[0.0, 0.03 * m, 0.0] for m in range(32)]).to_yaml(tmp_path / "line.yaml")
    room = MeasuredRoom(str(data_dir / "rirs" / "polimi_ula32"), array_file=str(tmp_path / "line.yaml"))
    x = torch.zeros(2000)
    x[0] = 1.0
    for place in room.positions:
        arrival = room.render(x, standing(place, 2000), room.array, FS).abs().argmax(-1)
        late = arrival - travel(place[None], room.array.positions, FS)[0]
        assert 0 < late.median() < 4  # the loudspeaker rings
        assert (late - late.median()).abs().median() < 1


@pytest.mark.realdata
def test_a_measured_head_hears_the_left_on_the_left(data_dir):
    pytest.importorskip("h5py")
    file = str(data_dir / "rirs" / "surrey_brir" / "UniS_Anechoic_BRIR_16k.sofa")
    room = MeasuredRoom(file, clockwise=True)  # its azimuths are: responses at 270 degrees reach the left ear first
    torch.testing.assert_close(torch.linalg.vector_norm(room.positions, dim=-1), torch.full((37,), 1.5))
    x = torch.zeros(900)
    x[0] = 1.0
    left, right = room.render(x, standing((0.0, 1.5, 0.0), 900), room.array, FS).abs()
    assert left.max() > 3 * right.max()
    assert right.argmax() - left.argmax() == pytest.approx(0.09 / 343 * FS * (1 + math.pi / 2), abs=3)  # Woodworth
