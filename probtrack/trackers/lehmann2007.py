"""The tracker of Lehmann & Johansson 2007: steered power gated by voice activity, a bootstrap filter."""

import math
from importlib import resources
from pathlib import Path
from typing import Literal, get_args

from probtrack import dynamics, switching
from probtrack._checks import as_positive
from probtrack.audio import (
    EnergyVoiceActivity,
    FrontEnd,
    GeneralisedCrossCorrelation,
    ShortTimeSpectrum,
    SileroVoiceActivity,
    SteeredResponsePower,
    VoiceActivity,
)
from probtrack.errors import InputError
from probtrack.filters import Adaptive, ParticleFilter, Relocation, resampling
from probtrack.geometry import SPEED_OF_SOUND, MicrophoneArray, Region
from probtrack.likelihoods import SteeredPowerLikelihood
from probtrack.parameters import parameter_names, read_parameters
from probtrack.trackers.tracker import Tracker

Model = Literal[dynamics.Lehmann2007Model, "speech-silence", "teleconference", "odas", "moving-stopped"]
Scheme = Literal["systematic", "stratified", "multinomial", "residual"]
Detector = Literal["energy", "silero"]

_SCHEMES: dict[str, resampling.Resampler] = {
    "systematic": resampling.systematic,
    "stratified": resampling.stratified,
    "multinomial": resampling.multinomial,
    "residual": resampling.residual,
}


def lehmann2007(
    array: MicrophoneArray,
    region: Region,
    model: Model = "CU-LAN",
    *,
    parameters: str = "printed",
    num_particles: int = 500,
    threshold: float = 0.75,
    resample: Scheme = "systematic",
    exponent: float = 2.0,
    keep_out: float = 0.2,
    vad: Detector = "energy",
    vad_threshold: float = 8.0,
    vad_slope: float = 1.0,
    height: float | None = None,
    three_d: bool = False,
    fs: int = 16_000,
    frame_length: int = 512,
    hop: int = 256,
    band_low: float = 300.0,
    band_high: float = 3000.0,
    speed_of_sound: float = SPEED_OF_SOUND,
) -> Tracker:
    """Return the tracker of S1: steered power gated by voice activity and a bootstrap particle filter.

    Args:
        array: The microphones.
        region: Where the talker can be [m]; its z range, if it has one, matters in 3-D only, but must hold
            the height that is tracked.
        model: Motion model, by its name in the paper's Table 1, or a model that switches between several.
        parameters: Values of the models: `printed`, which are those of the paper and of the arguments below; `learned`
            from simulated walks and voices at several noise levels and reverberation times, for the models that have
            some; or a file of `probtrack fit`. The last two also find a lost talker again, if they were learned so, and
            replace `exponent`, `vad_threshold` and `vad_slope`.
        num_particles: Particles N. The paper has 75, begun around the talker; from anywhere it takes some hundred
            to find one.
        threshold: Resample when the effective sample size is below this share of N.
        resample: Resampling scheme.
        exponent: Exponent of the steered power in the likelihood.
        keep_out: No mouth is nearer than this to a microphone [m]; 0, no such rule, is the paper's.
        vad: Voice activity detector: level over a tracked noise floor, or the neural one of silero-vad.
        vad_threshold: Level over the noise floor that the energy detector takes for speech with probability 1/2 [dB].
        vad_slope: Steepness of the energy detector's decision [1/dB].
        height: Height z of the talker's mouth, for tracking in the plane [m]; the array's height if not given.
        three_d: Track height too (needs microphones that differ in all three axes to see it).
        fs: Working sampling rate [Hz].
        frame_length: Samples in a frame.
        hop: Samples between the starts of frames.
        band_low: Lowest frequency used [Hz].
        band_high: Highest frequency used [Hz].
        speed_of_sound: Speed of sound [m/s].

    Raises:
        InputError: for values that cannot be, naming them.

    References:
        E. A. Lehmann, A. M. Johansson, "Dynamics models for acoustic speaker tracking - preliminary
        results", PRJ-NICTA-PM-023, 2007: sections 2 and 3.1, N_thr of section 5.2. Frame length, hop and
        sampling rate are not given there.
    """
    if model not in get_args(Model):
        raise InputError(f"model must be one of {', '.join(get_args(Model))}, got {model!r}")
    if not math.isfinite(vad_threshold):
        raise InputError(f"vad_threshold must be finite, got {vad_threshold}")
    height = _height(array, region, height, three_d)
    where = region if three_d else region.plane()
    band = (band_low, band_high)
    as_positive(float(fs), "fs")
    as_positive(vad_slope, "vad_slope")
    stft = ShortTimeSpectrum(frame_length, hop)
    gcc = GeneralisedCrossCorrelation(array, fs=fs, frame_length=frame_length, band=band, speed_of_sound=speed_of_sound)
    power = SteeredResponsePower(
        array, lag_rate=gcc.lag_rate, num_lags=gcc.num_lags, height=height, speed_of_sound=speed_of_sound
    )
    detector: VoiceActivity
    if vad == "energy":
        detector = EnergyVoiceActivity(
            fs=fs, frame_length=frame_length, hop=hop, band=band, threshold=vad_threshold, slope=vad_slope
        )
    elif vad == "silero":
        detector = SileroVoiceActivity(fs=fs, hop=hop)
    else:
        raise InputError(f"vad must be 'energy' or 'silero', got {vad!r}")
    if resample not in _SCHEMES:
        raise InputError(f"resample must be one of {', '.join(_SCHEMES)}, got {resample!r}")
    particle_filter = ParticleFilter(
        _motion(model, where.axes, dt=hop / fs),
        SteeredPowerLikelihood(power, where, exponent=exponent, keep_out=keep_out),
        num_particles=num_particles,
        resample=Adaptive(_SCHEMES[resample], threshold),
        origin=array.centre,
    )
    tracker = Tracker(FrontEnd(stft, gcc, detector), particle_filter, where, fs=fs)
    return tracker if parameters == "printed" else _with_parameters(tracker, parameters, model)


def learned_models() -> dict[str, Path]:
    """Return the files of learned parameters that ship with probtrack, by the name of the motion model."""
    folder = Path(str(resources.files("probtrack") / "learned" / "lehmann2007"))
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def _with_parameters(tracker: Tracker, parameters: str, model: str) -> Tracker:
    """Return the tracker with the values of a file, which says whether lost talkers are found again."""
    path = Path(parameters)
    if parameters == "learned":
        learned = learned_models()
        if model not in learned:
            raise InputError(f"parameters: none are learned for {model}: there are those of {', '.join(learned)}")
        path = learned[model]
    if any(name.startswith("filter.relocation.") for name in parameter_names(path)):
        tracker.filter.relocation = Relocation()
    read_parameters(path, tracker, partly=True)  # what was kept fixed in training is not in the file
    return tracker


def _motion(model: str, axes: int, *, dt: float) -> dynamics.Dynamics:
    """Return the model of that name; chains are for the tracker's own frames, Table 1 for those of S1."""
    make = switching.PRESETS.get(model)
    return dynamics.lehmann2007(model, axes) if make is None else make(axes, dt=dt)


def _height(array: MicrophoneArray, region: Region, height: float | None, three_d: bool) -> float | None:
    """Return the height of the tracked plane, None where there is no third axis; check both against the region."""
    if array.axes == 2:
        if three_d or height is not None:
            what = "tracking in 3-D" if three_d else "a height"
            raise InputError(f"{array.name}: {what} needs microphone positions (x, y, z), these are (x, y)")
        return None
    if three_d:
        if height is not None:
            raise InputError(f"height is for tracking in the plane: three_d tracks it, got {height:g}")
        if region.axes == 2:
            raise InputError("tracking in 3-D needs a region with a z range: low and high of 3 values")
        return None
    plane = float(array.centre[2]) if height is None else height
    if region.axes == 3 and not region.low[2] <= plane <= region.high[2]:
        raise InputError(
            f"the region's height, z {region.low[2]:g} to {region.high[2]:g} m, misses the plane that is tracked, "
            f"z = {plane:g} m" + (" (the array's)" if height is None else "")
        )
    return plane
