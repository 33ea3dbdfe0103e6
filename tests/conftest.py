import os
import pathlib

import pytest
import torch
from scenes import scene as scene


@pytest.fixture(autouse=True)
def float64_and_seed():
    """Every test runs in float64, on one thread, from a fixed seed."""
    before, threads = torch.get_default_dtype(), torch.get_num_threads()
    torch.set_default_dtype(torch.float64)
    torch.set_num_threads(1)
    torch.manual_seed(0)
    yield
    torch.set_default_dtype(before)
    torch.set_num_threads(threads)


@pytest.fixture(scope="session")
def data_dir():
    """Folder of the real recordings; the test that asks for it skips where there is none."""
    here = pathlib.Path(__file__).resolve().parents[1]
    folder = pathlib.Path(os.environ.get("PROBTRACK_DATA", here / "../shared/data"))
    if not folder.is_dir():
        pytest.skip(f"real recordings not found at {folder}: set PROBTRACK_DATA to their folder")
    return folder.resolve()
