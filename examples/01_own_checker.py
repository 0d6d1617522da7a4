"""APEX in an OMPL script that has a validity checker of its own; ten lines, of which one names APEX."""

from ompl import base as ob
from ompl import geometric as og

from apex_ompl import planners, robot
from apex_ompl.ompl import space

panda = robot.load_robot("dual_panda_softhand")
setup = og.SimpleSetup(space.state_space(panda))
setup.setStateValidityChecker(lambda state: not -0.3 < state[0] < 0.3 or state[1] < -0.4)  # yours
start, goal = panda.home.copy(), panda.home.copy()
start[0], goal[0] = -0.8, 0.8
setup.setStartAndGoalStates(*(space.to_state(setup.getSpaceInformation(), q) for q in (start, goal)))
setup.setPlanner(planners.APEX(setup.getSpaceInformation()))
status = setup.solve(ob.timedPlannerTerminationCondition(10.0)).getStatus()
print(status.name, f"{setup.getSolutionPath().length():.1f} rad")
