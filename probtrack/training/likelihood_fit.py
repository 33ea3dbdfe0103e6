"""Likelihood and front end trained where the talker is known to be. Imports Lightning when it is first named."""

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor

from probtrack._checks import check_int
from probtrack.dynamics import Kinematics
from probtrack.filters import Cloud, NoiseStream
from probtrack.filters.particle import frames_of
from probtrack.trackers import Tracker
from probtrack.training.batches import SceneBatch
from probtrack.training.fit import Fit
from probtrack.training.hearing import heard, keep_fixed, numbers_of, true_position
from probtrack.training.losses import NegativeLogEvidence, Outcome
from probtrack.training.settings import TrackerSettings


class LikelihoodFit(Fit):
    r"""Likelihood and front end in training at the talker's true position, without a filter.

    In every frame the true position is to be told from J others, drawn evenly from the region:

    .. math:: -\log \frac{p(y_t \mid \ell_t)}{p(y_t \mid \ell_t) + \sum_{j=1}^{J} p(y_t \mid \ell_j)} .

    The likelihood for which that is least is right up to a factor of the frame, whatever J; the more, the better small
    peaks are seen. (The density of the true position itself would be no measure: a sharp power is integrated on a
    grid, and the best exponent would be the one whose peaks the grid misses.) A step costs what hearing costs, which
    makes this the place to begin from before the whole tracker is trained by `SceneFit`. Motion is not trained.

    Args:
        tracker: Whose likelihood and front end are trained.
        others: J.
        warm_up: As in `SceneFit`.
        fixed: As in `SceneFit`.
        learning_rate: As in `Fit`.
        seed: Of the other positions.

    References:
        Z. Ma, M. Collins, "Noise contrastive estimation and negative sampling for conditional models: consistency and
        statistical efficiency", EMNLP 2018: the ranking objective.
    """

    def __init__(
        self,
        tracker: TrackerSettings,
        *,
        others: int = 200,
        warm_up: int = 0,
        fixed: Sequence[str] = ("front_end.gcc.whitening",),
        learning_rate: float = 0.05,
        seed: int = 0,
    ) -> None:
        super().__init__(tracker.make(), NegativeLogEvidence(), learning_rate=learning_rate, seed=seed)
        self.others = check_int(others, "others", low=1)
        self.warm_up = check_int(warm_up, "warm_up", low=0)
        parts = [f"filter.{name}" for name, _ in self.tracker.filter.named_children() if name != "likelihood"]
        named = [name for name, _ in self.model.named_parameters()]
        keep_fixed(self.model, [*fixed, *(part for part in parts if any(name.startswith(part) for name in named))])

    @property
    def tracker(self) -> Tracker:
        """What is trained."""
        return cast(Tracker, self.model)

    def numbers(self, batch: SceneBatch) -> Sequence[int]:
        return numbers_of(batch)

    def outcome(self, batch: SceneBatch, seeds: Tensor) -> Outcome:
        """Return the places of each frame as a cloud, whose evidence is the log probability of the true one."""
        tracker, likelihood = self.tracker, self.tracker.filter.likelihood
        prepared = frames_of(likelihood.prepare(heard(tracker, batch, self.warm_up)))
        position, known = true_position(tracker, batch, self.warm_up)
        noise = NoiseStream(seeds, self.others, 1, 1, dtype=position.dtype, device=position.device)
        others = tracker.region.from_unit(noise.uniform(len(position), self.others, position.shape[-1]))
        places = torch.cat([position[..., None, :], others.movedim(1, 0)], -2)  # (T, B, 1 + J, A)
        standing = torch.zeros_like(places[0])
        frames = zip(prepared, places.unbind(0), strict=True)
        log_density = torch.stack([likelihood(frame, Kinematics(place, standing)) for frame, place in frames])
        known = known & (log_density[..., 0] > -torch.inf)  # not a mouth nearer to a microphone than keep_out allows
        log_weight = torch.where(known[..., None], log_density, 0.0).log_softmax(-1)
        cloud = Cloud(places, log_weight, log_weight[..., 0], ~known)
        return Outcome(cloud, Kinematics(places, torch.zeros_like(places)), position, known, inside=known)
