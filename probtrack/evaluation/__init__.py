"""Monte-Carlo studies: trackers on recordings, many runs each, kept in a file that grows cell by cell."""
