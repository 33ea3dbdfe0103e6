"""The bootstrap particle filter, Algorithm 1 of S1, batched over runs and recordings."""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from probtrack._checks import check_event, check_int
from probtrack.dynamics import Dynamics, Kinematics, Move
from probtrack.errors import InputError, NotFiniteError, ShapeError
from probtrack.filters.cloud import Cloud, Frames, track_of
from probtrack.filters.noise import NoiseStream
from probtrack.filters.relocation import Relocate, Relocation
from probtrack.filters.resampling import Adaptive, Law, Resampler, systematic
from probtrack.geometry import Region
from probtrack.likelihoods import Likelihood
from probtrack.tracks import Track, join

_CHUNK = 2**17  # particles whose means are taken at once


class Belief(NamedTuple):
    """Particle cloud after a frame.

    Attributes:
        state: (*batch, N, D).
        log_weight: (*batch, N), logsumexp = 0.
        log_evidence: Accumulated log p(y_1:t) (*batch).
        heard: What a relocation remembers of the evidence, (*batch, G) with batch axes of size 1 shared; None without.
    """

    state: Tensor
    log_weight: Tensor
    log_evidence: Tensor
    heard: Tensor | None = None


class ParticleFilter(nn.Module):
    r"""Bootstrap filter: predict by the dynamics, weight by the likelihood, resample on low N_eff.

    .. math::
        x_t^{(n)} \sim p(x_t \mid x_{t-1}^{(n)}), \qquad
        w_t^{(n)} \propto w_{t-1}^{(n)}\, p(y_t \mid x_t^{(n)}), \qquad
        \hat\ell_t = \sum_n w_t^{(n)} \ell_t^{(n)}

    The module holds the models, so that `.parameters()` finds them, and no belief. Estimates are taken from
    the weighted cloud before it is resampled: the same in expectation as S1's, with less variance. A
    frame in which no particle is possible keeps the predicted cloud and its weights and is flagged `lost`.

    Args:
        dynamics: p(x_t | x_{t-1}).
        likelihood: p(y_t | x_t).
        num_particles: N.
        resample: What happens to the cloud after each frame; S1's by default: systematic, on
            N_eff < 0.75 N.
        origin: Point (A,) that azimuths are seen from [m]; none are given without it.
        relocation: How a lost talker is found again, for a likelihood with an `evidence_map`; not at all if None.

    Shape:
        observations (T, *batch, ...), one tensor or a NamedTuple of them, batch axes of size 1 are shared;
        belief (*batch, N, D); noise with the seeds of `batch`.

    References:
        S1 Algorithm 1; N. J. Gordon, D. J. Salmond, A. F. M. Smith, IEE Proc. F 140(2), 1993.
    """

    origin: Tensor | None

    def __init__(
        self,
        dynamics: Dynamics,
        likelihood: Likelihood,
        *,
        num_particles: int = 75,
        resample: Resampler | None = None,
        origin: Tensor | None = None,
        relocation: Relocation | None = None,
    ) -> None:
        super().__init__()
        self.dynamics, self.likelihood, self.relocation = dynamics, likelihood, relocation
        self.num_particles = check_int(num_particles, "num_particles", low=1)
        self.resample = Adaptive(systematic) if resample is None else resample
        _check_resampler(self.resample, dynamics, relocation)
        self.register_buffer("origin", origin, persistent=False)

    def noise(self, seeds: Tensor | int = 0) -> NoiseStream:
        """Return the random numbers of runs with `seeds` (*batch), for this filter's sizes."""
        like = next((p for p in self.parameters() if p.is_floating_point()), torch.empty(()))
        uniforms = self.resample.num_uniforms(self.num_particles, self.dynamics.state_dim)
        normals = self.dynamics.noise_dim
        if self.relocation is not None:
            normals += self.relocation.noise_dim(self.dynamics.axes)
        return NoiseStream(seeds, self.num_particles, normals, uniforms, dtype=like.dtype, device=like.device)

    def spread_over(self, region: Region, noise: NoiseStream, speed: float = 0.5) -> Belief:
        """Return a cloud uniform over `region`, moving at `speed` [m/s] r.m.s. on each axis."""
        return self._at_rest_in(region.from_unit(noise.uniform(self.num_particles, region.axes)), noise, speed)

    def spread_around(self, point: Tensor, noise: NoiseStream, std: float | Tensor = 0.1, speed: float = 0.5) -> Belief:
        """Return a Gaussian cloud of `std` [m] around `point` (*batch, A) [m], moving at `speed` [m/s]."""
        offset = std * noise.normal(self.num_particles, point.shape[-1])
        return self._at_rest_in(point.to(offset)[..., None, :] + offset, noise, speed)

    def _at_rest_in(self, position: Tensor, noise: NoiseStream, speed: float) -> Belief:
        velocity = speed * noise.normal(*position.shape[-2:])
        state = self.dynamics.from_kinematics(Kinematics(position, velocity))
        log_weight = position.new_full(position.shape[:-1], -math.log(self.num_particles))
        return Belief(state, log_weight, log_weight.new_zeros(log_weight.shape[:-1]))

    def forward(self, observations: Any, initial: Belief, dt: float | Tensor, noise: NoiseStream) -> Track:
        """Return the track of a whole sequence from the cloud `initial` before its first frame."""
        return self.advance(initial, observations, dt, noise)[1]

    def step(self, belief: Belief, observation: Any, dt: float, noise: NoiseStream) -> tuple[Belief, Track]:
        """Return the belief after one more frame, and its track of length one."""
        return self.advance(belief, with_time_axis(observation), dt, noise)

    def advance(
        self, belief: Belief, observations: Any, dt: float | Tensor, noise: NoiseStream
    ) -> tuple[Belief, Track]:
        """Return the belief after a block of frames and the track over it, `dt` [s] a frame.

        However a sequence is cut into blocks, clouds are the same, and their means but for rounding. `dt` is one
        number, or the time from the frame before for each frame (T,) or for each frame and run (T, *batch).

        Raises:
            InputError: for a time step that is not positive, or no frame.
            ShapeError: for a belief of other sizes than the filter's or the noise's.
            NotFiniteError: if a likelihood is NaN or infinite.
        """
        pieces, last = [], belief
        for after, frames in self._blocks(belief, observations, dt, noise):
            pieces.append(track_of(frames.together(), self.dynamics, self.origin))
            last = after
        track = join(pieces)
        evidence = belief.log_evidence + track.log_evidence.sum(0)
        return last._replace(log_evidence=evidence), track._replace(time=_times(dt, track.num_frames, belief.state))

    def run(self, belief: Belief, observations: Any, dt: float | Tensor, noise: NoiseStream) -> tuple[Belief, Cloud]:
        """Return the belief after a block of frames and the clouds of all its frames, for losses and for training.

        As `advance`, which keeps no more than the means: the clouds of T frames of N particles take T N D numbers.
        """
        ((last, frames),) = self._blocks(belief, observations, dt, noise, at_once=True)
        cloud = frames.together()
        return last._replace(log_evidence=belief.log_evidence + cloud.log_evidence.sum(0)), cloud

    def _blocks(
        self, belief: Belief, observations: Any, dt: float | Tensor, noise: NoiseStream, *, at_once: bool = False
    ) -> Iterator[tuple[Belief, Frames]]:
        """Yield the last belief, without its evidence, and the clouds of as many frames at a time as fit a cache."""
        check_event(belief.state, (self.num_particles, self.dynamics.state_dim), "state")
        _check_batch(belief, noise.batch)
        whole = self.likelihood.prepare(observations)
        prepared = list(frames_of(whole))
        if not prepared:
            raise InputError("observations hold no frame")
        _check_time_step(dt, len(prepared), noise.batch)
        size = len(prepared) if at_once else max(1, _CHUNK // max(1, belief.log_weight.numel()))
        state, log_weight = belief.state, belief.log_weight
        moves = iter(self._moves(observations, dt))
        relocations, heard = self._relocations(whole, observations, dt, belief.heard)
        steps = zip(relocations, moves, self._laws(dt), strict=False)
        before = None
        for start in range(0, len(prepared), size):
            block = prepared[start : start + size]
            state, log_weight, frames = self._run(state, log_weight, block, steps, noise, before)
            before = frames.state[-1], frames.log_weight[-1]
            yield Belief(state, log_weight, belief.log_evidence, heard), frames

    def _moves(self, observations: Any, dt: float | Tensor) -> Iterable[Move]:
        """Return the step into each frame; one of its own for each where time steps differ."""
        if not isinstance(dt, Tensor) or dt.ndim == 0:
            return self.dynamics.moves(observations, dt)
        return (
            next(iter(self.dynamics.moves(with_time_axis(frame), _one_step(step))))
            for frame, step in zip(frames_of(observations), dt.unbind(0), strict=True)
        )

    def _laws(self, dt: float | Tensor) -> Iterator[Law | None]:
        """Return the law of the step into each frame, for a resampler that asks for it."""
        if not self.resample.follows_moves:
            return itertools.repeat(None)
        if not isinstance(dt, Tensor) or dt.ndim == 0:
            return itertools.repeat(lambda state: self.dynamics(state, dt))
        return (partial(self._law, step=_one_step(step)) for step in dt.unbind(0))

    def _law(self, state: Tensor, step: float | Tensor) -> Distribution:
        # one number for each run's particles, which lie one axis deeper here
        law: Distribution = self.dynamics(state, step[..., None] if isinstance(step, Tensor) else step)
        return law

    def _relocations(
        self, prepared: Any, observations: Any, dt: float | Tensor, heard: Tensor | None
    ) -> tuple[Iterator[Relocate | None], Tensor | None]:
        """Return what comes before the step into each frame, and what is remembered after the last."""
        if self.relocation is None:
            return itertools.repeat(None), None
        evidence = self.likelihood.evidence_map(prepared)
        if evidence is None:
            name = type(self.likelihood).__name__
            raise InputError(f"relocation needs a likelihood with an evidence_map, {name} has none")
        speech = getattr(observations, "speech", None)
        found: tuple[Iterator[Relocate], Tensor] = self.relocation(self.dynamics, evidence, speech, dt, heard)
        return found

    def _run(
        self,
        state: Tensor,
        log_weight: Tensor,
        frames: Sequence[Any],
        steps: Iterator[tuple[Relocate | None, Move, Law | None]],
        noise: NoiseStream,
        before: tuple[Tensor, Tensor] | None,
    ) -> tuple[Tensor, Tensor, Frames]:
        """Run Algorithm 1 over `frames`; returns the last cloud and, of each frame, the weighted one.

        `before` is the cloud of the frame before, not yet resampled, if it is known.
        """
        # looked up once: nn.Module finds its parts slowly, and this loop is the whole cost of a small filter
        likelihood, kinematics, resample = self.likelihood, self.dynamics.kinematics, self.resample
        none_lost = torch.zeros(log_weight.shape[:-1], dtype=torch.bool, device=log_weight.device)
        motion_noise = self.dynamics.noise_dim
        clouds = Frames([], [], [], [], [])
        for observation, (relocate, move, law) in zip(
            frames, steps, strict=False
        ):  # there may be more steps than frames
            normal, uniform = noise.frame()
            predicted = log_weight
            if relocate is not None:
                rest = normal.shape[-1] - motion_noise
                state, relocated, log_proposal = relocate(state, log_weight, normal.narrow(-1, motion_noise, rest))
                predicted, normal = predicted + relocated, normal.narrow(-1, 0, motion_noise)
                if log_proposal is not None:
                    clouds.log_proposal.append(log_proposal)
            state, correction = move(state, normal)  # step 1, prediction
            predicted = predicted if correction is None else predicted + correction
            if law is not None and before is not None:
                state, predicted = resample.after_move(before, state, predicted, law)
            joint = predicted + likelihood(observation, kinematics(state))  # step 2, update
            log_weight, lost = torch.log_softmax(joint, -1), none_lost
            # log_softmax of a row that is -inf throughout is NaN throughout: its first number tells
            first = log_weight.detach()[..., 0]
            if math.isnan((first.sum() if first.ndim else first).item()):
                # a corrected weight sums to 1 in expectation only
                corrected = relocate is not None or correction is not None or not resample.normalised
                joint, log_weight, lost = _kept(joint, predicted.log_softmax(-1) if corrected else predicted)
            clouds.state.append(state)
            clouds.log_weight.append(log_weight)
            clouds.joint.append(joint)
            clouds.lost.append(lost)
            before = state, log_weight
            state, log_weight = resample(state, log_weight, uniform)  # step 3, resampling
        if len(clouds.state) < len(frames):
            raise ShapeError("what the dynamics listens to must have as many frames as the observations, got fewer")
        return state, log_weight, clouds


def _kept(joint: Tensor, predicted: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return both weights of a frame with the `predicted` where no particle was possible, and where that is."""
    if not (joint < torch.inf).all():
        raise NotFiniteError("a likelihood is NaN or infinite: an observation or a parameter is not finite")
    lost = joint.isneginf().all(-1)
    # taken out before the softmax: its gradient at a row of -inf is NaN even where nothing asks for it
    joint = torch.where(lost[..., None], predicted, joint)
    return joint, torch.where(lost[..., None], predicted, torch.log_softmax(joint, -1)), lost


def _check_resampler(resample: Resampler, dynamics: Dynamics, relocation: Relocation | None) -> None:
    if not resample.copies:
        with torch.no_grad():
            modes = dynamics.mode(torch.zeros(1, dynamics.state_dim))
        if modes is not None:
            raise InputError(
                f"resample must copy particles, {type(dynamics).__name__} has modes, which cannot be blended: take a "
                f"scheme such as StopGradient(systematic), got {resample}"
            )
    if resample.follows_moves and relocation is not None:
        raise InputError(
            "resample must not follow moves with relocation, whose law it does not know: take StopGradient"
        )


def _check_batch(belief: Belief, batch: tuple[int, ...]) -> None:
    if belief.state.shape[:-2] != batch:
        raise ShapeError(f"noise must have the belief's batch {tuple(belief.state.shape[:-2])}, its seeds have {batch}")
    if belief.log_weight.shape != belief.state.shape[:-1]:
        raise ShapeError(
            f"log_weight must have shape {tuple(belief.state.shape[:-1])}, got {tuple(belief.log_weight.shape)}"
        )


def _check_time_step(dt: float | Tensor, frames: int, batch: tuple[int, ...]) -> None:
    if isinstance(dt, Tensor) and dt.ndim > 0:
        if dt.shape not in ((frames,), (frames, *batch)):
            raise ShapeError(f"dt must be one number or have shape ({frames}, *{batch}), got {tuple(dt.shape)}")
        bad = ~(dt.isfinite() & (dt > 0))
        if bad.any():
            frame = int(bad.nonzero()[0, 0])
            raise InputError(f"dt must be positive seconds, got {dt[frame].tolist()} into frame {frame}")
    elif not (isinstance(dt, (int, float, Tensor)) and math.isfinite(dt) and dt > 0):
        raise InputError(f"dt must be a positive number of seconds, got {dt}")


def _one_step(dt: Tensor) -> float | Tensor:
    """Return the time step of a frame as one number if all runs share it, else one for each run's particles."""
    return dt.flatten()[0].item() if (dt == dt.flatten()[0]).all() else dt[..., None]


def _times(dt: float | Tensor, frames: int, like: Tensor) -> Tensor:
    """Return the times of frames (T,) from the first one on [s]; those of the first run where runs differ."""
    if isinstance(dt, Tensor) and dt.ndim > 0:
        steps = dt.reshape(frames, -1)[:, 0].to(like)
        return steps.cumsum(0) - steps[0]
    return dt * torch.arange(frames, dtype=like.dtype, device=like.device)


def frames_of(observations: Any) -> Iterator[Any]:
    """Yield the frames of a tensor (T, ...) or a NamedTuple of such tensors."""
    if isinstance(observations, Tensor):
        return iter(observations.unbind(0))
    return (type(observations)(*columns) for columns in zip(*(x.unbind(0) for x in observations), strict=True))


def with_time_axis(observation: Any) -> Any:
    """Return one frame of observations as a sequence of one."""
    if isinstance(observation, Tensor):
        return observation[None]
    return type(observation)(*(x[None] for x in observation))
