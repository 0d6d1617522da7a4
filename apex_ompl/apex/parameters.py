"""Parameters of APEX; torch is imported when a planner is built."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, TypedDict

from apex_ompl.ompl.parameters import Parameters, bounded, one_of, register
from apex_ompl.ompl.tuned import TUNED

if TYPE_CHECKING:
    from ompl import base as ob

    from apex_ompl.apex.stages import Stage
    from apex_ompl.model.proposals import Sampling

NAME = "apex"
AUTO = "auto"  # what fits the setup
TURN_CALLS = 1_000  # of the termination condition of a bridge where rounds and trees take turns
QUICK_CALLS = 1500  # iterations of a bridge between rounds of proposals
AGAIN = 8  # factor on the iterations of the sprint after the short repair of the first round
SPRINT_FACTORS = (1, 8, 32)  # on those of the sprints before each round of proposals
CONSTRAINED_SPRINT = 32  # the same under constraints, where the line and proposals take longer


@register(NAME)
@dataclass(frozen=True)
class ApexParameters(Parameters):
    """Proposals of a latent diffusion model, repaired, bridged, and completed by RRTConnect.

    Attributes:
        model: Name or folder of a checkpoint; ``auto`` takes the one that ships for the robot, or ``none`` where there
            is none: random perturbations of straight lines.
        robot: The robot, by name or file, where the validity checker is not this project's; ``auto`` takes that of the
            setup of ``apex_ompl.setup``, or else ``dual_panda_softhand``.
        device: Where the network runs.
        line: Whether the straight line is a candidate.
        sprint: Iterations that RRT-Connect has before proposals, where it is the fallback and ``lambda_obs`` is 0;
            after a short repair and before the second round it has 8 times as many, before the third 32 times;
            under constraints 32 times at once. That is for trees in compiled code; OMPL's have an eighth.
        sampler: ``ddim``, ``dpm_solver`` or ``ddpm``; ``model`` takes that of the checkpoint.
        denoising_steps: Number of denoising steps; 0 takes that of the checkpoint: 2 for apex, all 256 for apex-paper.
        temperature: Factor on the standard deviation of the checkpoint's initial noise.
        first: Proposals for each pair of start and goal in the first round.
        second: In the second.
        third: In the third.
        guidance: Whether paths are drawn away from obstacles while they are denoised.
        gamma: Factor on the scale of the guidance that was chosen for its scaling.
        scaling: What it changes of a sample: ``clean``, the path that is expected of it, or ``noise``, as equation 7 of
            the paper has it.
        resample: How often colliding candidates are resampled in each round.
        noise: How far they are noised for that, as a share of the schedule.
        lambda_obs: Distance from obstacles below which valid paths are resampled, too; without a better one, the path
            with the largest distance is taken.
        repair: Whether candidates are improved by the optimizer.
        bridge: Whether blocked stretches of the best candidates are bridged by short trees.
        fallback: Whether RRTConnect takes turns with more rounds of proposals in the time that is left, and sprints
            before; otherwise there are more rounds of proposals alone.
        polish: Whether valid paths are shortened.
        approximate: Whether, without an exact solution, a path that ends near a goal is given as an approximate one.
        anytime: Whether paths are improved until the time is up, or until they satisfy the path length objective, where
            there is one; ``plan`` improves the motion in their place, unless its objective is ``length``. An OMPL
            objective alone does not ask for it: OMPL's optimizing planners leave one in the problem.
        range: Longest step of RRTConnect's trees in sprints, in bridges and as fallback, by default the tuned one; 0
            lets OMPL choose.
        seed: Of the proposals' noise; -1 takes one that follows from OMPL's.
    """

    smooth: ClassVar[bool] = True
    constrained: ClassVar[bool] = True
    model: str = AUTO
    robot: str = AUTO
    device: str = "cpu"
    line: bool = True
    sprint: int = bounded(TUNED[NAME]["sprint"], 0)
    sampler: str = one_of("model", "ddim", "dpm_solver", "ddpm")
    denoising_steps: int = bounded(0, 0, 1000)
    temperature: float = bounded(1.0, 0.0, 10.0)
    first: int = bounded(TUNED[NAME]["first"], 0, 1024)
    second: int = bounded(8, 0, 1024)
    third: int = bounded(24, 0, 1024)
    guidance: bool = False
    gamma: float = bounded(1.0, 0.0, 1e3)
    scaling: str = one_of("clean", "noise")
    resample: int = bounded(1, 0, 100)
    noise: float = bounded(0.4, 0.0, 1.0)
    lambda_obs: float = bounded(0.0, 0.0, 1.0, unit="m")
    repair: bool = True
    bridge: bool = True
    fallback: bool = True
    polish: bool = True
    approximate: bool = False
    anytime: bool = False
    range: float = bounded(TUNED[NAME]["range"], 0.0, unit="rad")
    seed: int = bounded(-1, -1)

    @property
    def sprints(self) -> bool:
        """Whether RRTConnect has short tries before proposals are made."""
        return self.fallback and self.sprint > 0 and self.lambda_obs == 0.0

    @property
    def batches(self) -> tuple[int, ...]:
        """Numbers of proposals in the rounds that make any."""
        return tuple(count for count in (self.first, self.second, self.third) if count)

    def sampling(self, default: Sampling) -> Sampling:
        """Return how proposals are denoised; ``default`` is the checkpoint's own sampling."""
        from apex_ompl.model import proposals
        from apex_ompl.model.guidance import GUIDANCES

        chosen = GUIDANCES[self.scaling]
        guidance = replace(chosen, gamma=self.gamma * chosen.gamma if self.guidance else 0.0)
        sampler = default.sampler if self.sampler == "model" else self.sampler
        steps, temperature = self.denoising_steps or default.steps, self.temperature * default.temperature
        return proposals.Sampling(sampler, steps, temperature, guidance)

    def stages(self) -> list[Stage]:
        """Return the stages of ``solve`` up to the first valid path, in their order."""
        from apex_ompl.apex import stages

        def proposal_round(count: int, temperature: float = 1.0, between: Sequence[Stage] = ()) -> list[Stage]:
            return stages.proposal_round(
                count, repair=self.repair, resample=self.resample, noise=self.noise, temperature=temperature,
                between=between,
            )  # fmt: skip

        found: list[Stage] = [stages.KnownCandidates(self.line)]
        for number, count in enumerate(self.batches or (0,)):
            if self.sprints:
                found.append(stages.Sprint(self.sprint * SPRINT_FACTORS[number], self.range, exact=number > 0))
            if number == 0:
                found.append(stages.CheckKnown())
            again = number == 0 and self.sprints
            between = [stages.Sprint(self.sprint * AGAIN, self.range, exact=True)] if again else []
            found += proposal_round(count, between=between)
            if self.bridge and self.lambda_obs == 0.0 and number < len(self.batches) - 1:
                found.append(stages.Bridging(self.range, QUICK_CALLS))
        found.append(stages.Farthest())
        if self.bridge:
            found.append(stages.Bridging(self.range))
        if self.approximate:
            found.append(stages.NearestToGoal())
        largest = max(self.batches, default=0)
        temperatures = stages.TEMPERATURES if self.repair else (1.0,)  # a wider spread is worse without repair
        rounds = [proposal_round(largest, temperature) for temperature in temperatures if largest]
        ends: list[Stage] = [stages.Farthest(), *([stages.Bridging(self.range, TURN_CALLS)] if self.bridge else [])]
        trees = stages.GrowTrees(self.range, self.approximate) if self.fallback else None
        found.append(stages.TakeTurns(trees, tuple((*one, *ends) for one in rounds)))
        return found

    def constrained_stages(self) -> list[Stage]:
        """Return the stages of ``solve`` under constraints along the path, up to the first valid path."""
        from apex_ompl.apex import stages

        found: list[Stage] = []
        if self.sprints:
            found.append(stages.ConstrainedTrees(CONSTRAINED_SPRINT * self.sprint))
        if self.line:
            found.append(stages.ConstrainedLines())
        found += [stages.ConstrainedProposals(count) for count in self.batches[:1]]
        found.append(stages.ConstrainedTurns(self.fallback, max(self.batches, default=0)))
        return found

    def build(self, si: ob.SpaceInformation) -> ob.Planner:
        """Return the planner.

        Raises:
            ApexError: The model or the robot cannot be loaded, or do not fit the space.
        """
        from apex_ompl.apex.planner import APEX

        return APEX(si, self)


class ApexKeywords(TypedDict, total=False):
    """:class:`ApexParameters` as keywords of :class:`apex_ompl.planners.APEX`, for editors and type checkers."""

    model: str
    robot: str
    device: str
    line: bool
    sprint: int
    sampler: str
    denoising_steps: int
    temperature: float
    first: int
    second: int
    third: int
    guidance: bool
    gamma: float
    scaling: str
    resample: int
    noise: float
    lambda_obs: float
    repair: bool
    bridge: bool
    fallback: bool
    polish: bool
    approximate: bool
    anytime: bool
    range: float
    seed: int
