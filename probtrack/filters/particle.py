"""The bootstrap particle filter, Algorithm 1 of S1, batched over runs and recordings."""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from probtrack._checks import check_event, check_int
from probtrack.dynamics import Dynamics, Kinematics, Move
from probtrack.errors import InputError, NotFiniteError, ShapeError
from probtrack.filters.cloud import Clouds, summary
from probtrack.filters.noise import NoiseStream
from probtrack.filters.resampling import Adaptive, Resampler, systematic
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
    """

    state: Tensor
    log_weight: Tensor
    log_evidence: Tensor


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
    ) -> None:
        super().__init__()
        self.dynamics, self.likelihood = dynamics, likelihood
        self.num_particles = check_int(num_particles, "num_particles", low=1)
        self.resample = Adaptive(systematic) if resample is None else resample
        self.register_buffer("origin", origin, persistent=False)

    def noise(self, seeds: Tensor | int = 0) -> NoiseStream:
        """Return the random numbers of runs with `seeds` (*batch), for this filter's sizes."""
        like = next((p for p in self.parameters() if p.is_floating_point()), torch.empty(()))
        uniforms = self.resample.num_uniforms(self.num_particles)
        return NoiseStream(
            seeds, self.num_particles, self.dynamics.noise_dim, uniforms, dtype=like.dtype, device=like.device
        )

    def spread_over(self, region: Region, noise: NoiseStream, speed: float = 0.5) -> Belief:
        """Return a cloud uniform over `region`, moving at `speed` [m/s] r.m.s. on each axis."""
        return self._at_rest_in(region.from_unit(noise.uniform(self.num_particles, region.axes)), noise, speed)

    def spread_around(self, point: Tensor, noise: NoiseStream, std: float = 0.1, speed: float = 0.5) -> Belief:
        """Return a Gaussian cloud of `std` [m] around `point` (*batch, A) [m], moving at `speed` [m/s]."""
        offset = std * noise.normal(self.num_particles, point.shape[-1])
        return self._at_rest_in(point.to(offset)[..., None, :] + offset, noise, speed)

    def _at_rest_in(self, position: Tensor, noise: NoiseStream, speed: float) -> Belief:
        velocity = speed * noise.normal(*position.shape[-2:])
        state = self.dynamics.from_kinematics(Kinematics(position, velocity))
        log_weight = position.new_full(position.shape[:-1], -math.log(self.num_particles))
        return Belief(state, log_weight, log_weight.new_zeros(log_weight.shape[:-1]))

    def forward(self, observations: Any, initial: Belief, dt: float, noise: NoiseStream) -> Track:
        """Return the track of a whole sequence from the cloud `initial` before its first frame."""
        return self.advance(initial, observations, dt, noise)[1]

    def step(self, belief: Belief, observation: Any, dt: float, noise: NoiseStream) -> tuple[Belief, Track]:
        """Return the belief after one more frame, and its track of length one."""
        return self.advance(belief, _with_time_axis(observation), dt, noise)

    def advance(self, belief: Belief, observations: Any, dt: float, noise: NoiseStream) -> tuple[Belief, Track]:
        """Return the belief after a block of frames and the track over it, `dt` [s] a frame.

        However a sequence is cut into blocks, clouds are the same, and their means but for rounding.

        Raises:
            InputError: for a time step that is not positive, or no frame.
            ShapeError: for a belief of other sizes than the filter's or the noise's.
            NotFiniteError: if a likelihood is NaN or infinite.
        """
        if not (isinstance(dt, (int, float)) and math.isfinite(dt) and dt > 0):
            raise InputError(f"dt must be a positive number of seconds, got {dt}")
        check_event(belief.state, (self.num_particles, self.dynamics.state_dim), "state")
        _check_batch(belief, noise.batch)
        prepared = list(_frames(self.likelihood.prepare(observations)))
        if not prepared:
            raise InputError("observations hold no frame")
        frames_at_once = max(1, _CHUNK // max(1, belief.log_weight.numel()))
        pieces = []
        state, log_weight = belief.state, belief.log_weight
        moves = iter(self.dynamics.moves(observations, dt))
        for start in range(0, len(prepared), frames_at_once):
            frames = prepared[start : start + frames_at_once]
            state, log_weight, clouds = self._run(state, log_weight, frames, moves, noise)
            pieces.append(summary(clouds, self.dynamics, self.origin))
        track = join(pieces)
        time = dt * torch.arange(track.num_frames, dtype=state.dtype, device=state.device)
        evidence = belief.log_evidence + track.log_evidence.sum(0)
        return Belief(state, log_weight, evidence), track._replace(time=time)

    def _run(
        self, state: Tensor, log_weight: Tensor, frames: Sequence[Any], moves: Iterator[Move], noise: NoiseStream
    ) -> tuple[Tensor, Tensor, Clouds]:
        """Run Algorithm 1 over `frames`; returns the last cloud and, of each frame, the weighted one."""
        # looked up once: nn.Module finds its parts slowly, and this loop is the whole cost of a small filter
        likelihood, kinematics, resample = self.likelihood, self.dynamics.kinematics, self.resample
        none_lost = torch.zeros(log_weight.shape[:-1], dtype=torch.bool, device=log_weight.device)
        clouds = Clouds([], [], [], [])
        for observation, move in zip(frames, moves, strict=False):  # there may be more moves than frames
            normal, uniform = noise.frame()
            state, correction = move(state, normal)  # step 1, prediction
            predicted = log_weight if correction is None else log_weight + correction
            joint = predicted + likelihood(observation, kinematics(state))  # step 2, update
            log_weight, lost = torch.log_softmax(joint, -1), none_lost
            # log_softmax of a row that is -inf throughout is NaN throughout: its first number tells
            first = log_weight[..., 0]
            if math.isnan((first.sum() if first.ndim else first).item()):
                # a corrected weight sums to 1 in expectation only
                joint, log_weight, lost = _kept(joint, predicted if correction is None else predicted.log_softmax(-1))
            clouds.state.append(state)
            clouds.log_weight.append(log_weight)
            clouds.joint.append(joint)
            clouds.lost.append(lost)
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


def _check_batch(belief: Belief, batch: tuple[int, ...]) -> None:
    if belief.state.shape[:-2] != batch:
        raise ShapeError(f"noise must have the belief's batch {tuple(belief.state.shape[:-2])}, its seeds have {batch}")
    if belief.log_weight.shape != belief.state.shape[:-1]:
        raise ShapeError(
            f"log_weight must have shape {tuple(belief.state.shape[:-1])}, got {tuple(belief.log_weight.shape)}"
        )


def _frames(observations: Any) -> Iterator[Any]:
    """Yield the frames of a tensor (T, ...) or a NamedTuple of such tensors."""
    if isinstance(observations, Tensor):
        return iter(observations.unbind(0))
    return (type(observations)(*columns) for columns in zip(*(x.unbind(0) for x in observations), strict=True))


def _with_time_axis(observation: Any) -> Any:
    if isinstance(observation, Tensor):
        return observation[None]
    return type(observation)(*(x[None] for x in observation))
