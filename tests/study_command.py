"""A quick study as a command does it, with whatever a test changes in its file."""

import shutil

import pytest
import yaml
from study_scenes import write_recording

from probtrack.cli.main import main

SMALL = {"scenes": ["near"], "trackers": {"A": "lehmann2007"}, "vary": {"num_particles": [30, 45]}, "runs": 2}


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recording")
    write_recording(folder / "near", (2.4, 1.1, 1.3), 0.6)
    return folder / "near"


@pytest.fixture
def study(tmp_path, recording, capsys):
    """Run a study with changes, and return its code and the lines it said."""
    shutil.copytree(recording, tmp_path / "near")

    def run(*flags, **changes):
        written(run, **changes)
        code = main(["evaluate", str(tmp_path / "study.yaml"), "-o", str(tmp_path / "s.sqlite"), *flags])
        return code, capsys.readouterr().err.splitlines()

    run.folder, run.store = tmp_path, tmp_path / "s.sqlite"
    return run


def written(study, **changes):
    """Write the study file with changes, None for what it does not say, and return its path."""
    content = {key: value for key, value in {**SMALL, **changes}.items() if value is not None}
    (study.folder / "study.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    return study.folder / "study.yaml"


def says(outcome, *words):
    """The command ended with 2 and said all of `words` in its one line."""
    code, lines = outcome
    assert code == 2
    assert len(lines) == 1, lines
    assert lines[0].startswith("probtrack evaluate: error: ")
    for word in words:
        assert word in lines[0], lines[0]
