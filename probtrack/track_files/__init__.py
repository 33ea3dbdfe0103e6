"""Tables of tracks and of truth: written as frames come, read back with checks. CSV, JSON lines, Parquet."""

from probtrack.track_files.columns import COLUMNS as COLUMNS
from probtrack.track_files.columns import SUFFIXES as SUFFIXES
from probtrack.track_files.columns import Row as Row
from probtrack.track_files.reading import TrackTable as TrackTable
from probtrack.track_files.reading import read_track as read_track
from probtrack.track_files.reading import read_tracks as read_tracks
from probtrack.track_files.writing import TrackWriter as TrackWriter
from probtrack.track_files.writing import check_track_output as check_track_output
from probtrack.track_files.writing import rows_of as rows_of
