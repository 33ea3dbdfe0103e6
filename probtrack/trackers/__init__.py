"""The papers' systems, assembled: audio in, track out."""

from probtrack.trackers.lehmann2007 import lehmann2007 as lehmann2007
from probtrack.trackers.tracker import Tracker as Tracker
from probtrack.trackers.tracker import TrackerState as TrackerState
