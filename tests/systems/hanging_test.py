import numpy as np
import pytest

from systems.hanging import begin_lift, feel_weight
from systems.planner_state import PlannerState


@pytest.mark.parametrize(("full", "is_late"), [(1.55, True), (1.45, False)])
def test_a_light_object_that_leaves_the_table_late_is_noticed(full: float, is_late: bool):
    """Until it hangs free, the table bears a small share of its weight of about 1.5 N."""
    state = PlannerState(np.zeros(PlannerState.size))
    begin_lift(state, 0.0)
    for millimetre in range(40):
        feel_weight(state, 1.3 if millimetre < 30 else full, millimetre / 1000)
    assert (state.steady_z > 0.029) is is_late
