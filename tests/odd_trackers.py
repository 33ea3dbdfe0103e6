"""Trackers and metrics of a user's own that go wrong."""

import torch

from probtrack.metrics import Parts, TrackMetric
from probtrack.trackers import Tracker, lehmann2007


class Changed(Tracker):
    """A tracker whose track is not what it should be."""

    def forward(self, samples, seeds=0, start=None, *, block=1.0):
        track = super().forward(samples, seeds, start, block=block)
        track.position[17, 1] = torch.nan
        return track


def not_finite(array, region, num_particles: int = 50):
    """Make a tracker with a NaN in the second run."""
    made = lehmann2007(array, region, num_particles=num_particles)
    return Changed(made.front_end, made.filter, made.region)


class Failing(Tracker):
    """A tracker with a slip that shows in large clouds."""

    def forward(self, samples, seeds=0, start=None, *, block=1.0):
        1 / (65 - self.filter.num_particles)
        return super().forward(samples, seeds, start, block=block)


def failing(array, region, num_particles: int = 50):
    """Make a tracker that cannot do with 65 particles."""
    made = lehmann2007(array, region, num_particles=num_particles)
    return Failing(made.front_end, made.filter, made.region)


def nothing(array, region, num_particles: int = 50):
    """Make no tracker."""


class NoNumber(TrackMetric):
    """A metric that is NaN in the last run."""

    name = "no_number"

    def judge(self, estimate, truth):  # noqa: ARG002
        figure = estimate.position[0, :, 0, 0].clone()
        figure[-1] = torch.nan
        return Parts(figure, torch.ones_like(figure))


def simple(array, region):
    """Make a tracker that has no settings."""
    return lehmann2007(array, region, num_particles=30)


def open_ended(array, region, **settings):
    """Make a tracker that takes what is said."""
    return lehmann2007(array, region, **settings)


def worded(array, region, words: str = "none"):  # noqa: ARG001
    """Make a tracker of which a setting is a text."""
    return lehmann2007(array, region, num_particles=30)


def broken(array, region):
    """Make no tracker, by a slip."""
    return array.nowhere + region


class Nameless(TrackMetric):
    """A metric that is called nothing."""

    def judge(self, estimate, truth):  # noqa: ARG002
        figure = estimate.position[0, :, 0, 0]
        return Parts(figure, torch.ones_like(figure))


class Misnamed(Nameless):
    """A metric that is called like a column of every table."""

    name = "seconds"


class Numbered(Nameless):
    """A metric whose name is no text."""

    name = 3


class Slipped(Nameless):
    """A metric that cannot be made, by a slip."""

    name = "slipped"

    def __init__(self):
        super().__init__()
        self.share = 1 / 0
