"""How talkers walk, stop and turn."""
