"""Whole impulse responses of rectangular rooms: what holds of them without any other summation."""

import math

import pytest
import torch

from probtrack.errors import InputError
from probtrack.geometry import MicrophoneArray
from probtrack.simulation.rooms import LEAD, SPEECH, ShoeboxRoom

FS = 16000
SIZE = (3.5, 3.1, 2.2)
ROOM = ShoeboxRoom(SIZE, 0.12)
DRY = ShoeboxRoom(SIZE, 0.0)

reverberant = pytest.mark.usefixtures("pyroomacoustics")


@pytest.fixture
def pyroomacoustics():
    return pytest.importorskip("pyroomacoustics")


def array():
    return MicrophoneArray([[1.35, 0.29, 1.51], [2.15, 0.31, 1.42], [3.01, 1.95, 1.38]], "three")


@reverberant
def test_reciprocity():
    points = torch.tensor([[1.1, 1.9, 1.5], [2.8, 0.7, 0.9]])
    there = ROOM.impulse_responses(points, array(), FS)
    back = ROOM.impulse_responses(array().positions, MicrophoneArray(points), FS)
    torch.testing.assert_close(there, back.transpose(0, 1), rtol=0, atol=2e-3)


@reverberant
def test_reflections_leave_the_direct_path_alone():
    point, end = torch.tensor([[1.6, 0.7, 1.3]]), LEAD + 32  # heard after 24 samples, by the wall after 49
    dry, wet = (room.impulse_responses(point, array(), FS)[0, 0] for room in (DRY, ROOM))
    torch.testing.assert_close(wet[:end], dry[:end], rtol=0, atol=0.02 * float(dry.max()))


@pytest.mark.parametrize("point", [(1.13, 1.71, 1.51), (0.01, 0.02, 0.0), (1.40, 0.39, 1.45)])
def test_without_reflections_only_the_direct_sound_is_left(point):
    h = DRY.impulse_responses(torch.tensor([point]), array(), FS)[0]
    for response, microphone in zip(h, array().positions.tolist(), strict=True):
        d = math.dist(point, microphone)
        n = torch.arange(len(response)) - LEAD - d / 343 * FS
        f = torch.tensor([500.0, 3000.0, 7000.0])
        spectrum = (response * torch.exp(-2j * torch.pi * f[:, None] / FS * n)).sum(-1)
        torch.testing.assert_close(spectrum, torch.full((3,), 1 / d, dtype=spectrum.dtype), rtol=0, atol=0.01 / d)


@reverberant
def test_nothing_arrives_before_the_direct_path():
    point = torch.tensor([[1.1, 1.9, 1.5]])
    h = ROOM.impulse_responses(point, array(), FS)[0]
    for response, d in zip(h, torch.cdist(point, array().positions)[0], strict=True):
        assert response[: LEAD + int(d / 343.0 * FS) - 20].abs().max() < 0.02 * response.abs().max()


@reverberant
@pytest.mark.parametrize("fs", [8000, 48000])
def test_responses_are_the_same_at_any_sampling_rate(fs):
    point, f = torch.tensor([[1.1, 1.9, 1.5]]), torch.tensor([500.0, 1100.0, 2900.0])

    def at(fs):
        h = ROOM.impulse_responses(point, array(), fs)[0]
        n = torch.arange(h.shape[-1]) - LEAD
        return (h[:, None] * torch.exp(-2j * torch.pi * f[:, None] / fs * n)).sum(-1)

    assert (at(fs) - at(FS)).abs().square().mean() < 1e-3 * at(FS).abs().square().mean()


def test_responses_have_the_default_dtype():
    assert DRY.impulse_responses(torch.ones(2, 3).float(), array(), FS).dtype == torch.float64
    torch.set_default_dtype(torch.float32)
    assert DRY.impulse_responses(torch.ones(2, 3), array(), FS).dtype == torch.float32


@pytest.mark.parametrize(
    ("points", "directivity", "mouth", "message"),
    [
        ((3,), None, None, r"points must have shape \(K, 3\), got \(3,\)"),
        ((2, 3), SPEECH, None, "mouth must be given for a source with a directivity, and only for one"),
        ((2, 3), None, [0.0, 1.0], "mouth must be given for a source with a directivity, and only for one"),
        ((2, 3), SPEECH, [0.0], r"mouth must be 2 finite angles \[rad\], got \(1,\)"),
        ((2, 3), SPEECH, [0.0, math.nan], r"mouth must be 2 finite angles"),
    ],
)
def test_rejects_points_and_mouths_that_do_not_fit(points, directivity, mouth, message):
    mouth = None if mouth is None else torch.tensor(mouth)
    with pytest.raises(InputError, match=message):
        ROOM.impulse_responses(torch.ones(points), array(), FS, directivity=directivity, mouth=mouth)
