"""Steps of every motion model refuse states and noise of other sizes, in one line."""

from typing import get_args

import pytest
import torch

from probtrack.dynamics import Lehmann2007Model, WithHeading, lehmann2007
from probtrack.errors import ShapeError
from probtrack.switching import PRESETS

MODELS = {name: lambda name=name: lehmann2007(name) for name in get_args(Lehmann2007Model)}
MODELS |= {name: lambda make=make: make(2) for name, make in PRESETS.items() if name in ("odas", "moving-stopped")}
MODELS |= {"heading": lambda: WithHeading(lehmann2007("CL-TCVE-TCAC", 3))}


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("extra", [-1, 1])
@pytest.mark.parametrize("listens", [False, True])
def test_a_step_names_what_has_another_size(name, extra, listens):
    model = MODELS[name]()
    state, noise = model.state_dim, model.noise_dim
    step = next(iter(model.moves(None, 0.1))) if listens else model.transition(0.1)
    with pytest.raises(ShapeError, match=rf"state must have shape \(\.\.\., {state}\), got \(7, {state + extra}\)"):
        step(torch.zeros(7, state + extra), torch.zeros(7, noise))
    with pytest.raises(ShapeError, match=rf"noise must have shape \(\.\.\., {noise}\), got \(7, {noise + extra}\)"):
        step(torch.zeros(7, state), torch.zeros(7, noise + extra))
