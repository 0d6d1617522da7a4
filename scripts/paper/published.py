"""The numbers of the paper, and where each of ours is found among the results."""

from __future__ import annotations

from dataclasses import dataclass

from paper.table import Where


@dataclass(frozen=True)
class Entry:
    """A number of the paper.

    Attributes:
        figure: Its figure or section in the paper.
        what: Its meaning.
        paper: The paper's value.
        faithful: Entry of the system as the paper describes it.
        ours: Entry of this planner.
        number: Name of the number in these entries.
        differs: What differs, and why.
    """

    figure: str
    what: str
    paper: str
    faithful: Where
    ours: Where
    number: str
    differs: str


PICTURES = {
    "failure": "Failure ratio and smoothness by task (figure 7)",
    "size": "Failure ratio over the size of static cubes (figure 9)",
    "imposed": "Failure ratio over the size of cubes that are brought in (figure 9)",
    "dynamic": "Failure ratio over the size of cubes that pass (figure 9)",
    "strips": "With and without guidance, in reading order, up to a contact (figure 8)",
    "failures": "Failures: a collision, a robot that is stuck, a wrong alignment (figure 6)",
    "denoising": "Denoising, from above and from the side (figure 5)",
    "diversity": "Valid paths of one problem (figure 10a)",
    "fid": "FID of all algorithms (figure 10b)",
}
"""Pictures of the page, by result."""

STILL = "N and sizes are not given: one to three cubes of 6 to 30 cm; 10 s for each problem, 60 s for `apex-paper`"
CUBE = "one cube, three speeds; replans are charged"
LARGEST = "cubes of 30 cm; the models were trained with edges up to 15 cm, `apex-paper` sees one point of them"

ENTRIES = (
    Entry("7a", "R_f %, vertical", "5.57", ("failure", "vertical, apex-paper"), ("failure", "vertical, apex"), "R_f",
          STILL),
    Entry("7a", "R_f %, horizontal", "8.95", ("failure", "horizontal, apex-paper"), ("failure", "horizontal, apex"),
          "R_f", STILL),
    Entry("7a", "R_f %, vertical, moving", "(5.57)", ("dynamic", "tasks", "vertical, apex-paper"),
          ("dynamic", "tasks", "vertical, apex"), "R_f", f"the paper does not say whether cubes moved; {CUBE}"),
    Entry("7a", "R_f %, horizontal, moving", "(8.95)", ("dynamic", "tasks", "horizontal, apex-paper"),
          ("dynamic", "tasks", "horizontal, apex"), "R_f", "the same"),
    Entry("7b", "S_r rad", "2.36", ("failure", "both, apex-paper"), ("failure", "both, apex"), "S_r",
          "a path length: it grows with the distance of start and goal, which the paper does not give"),
    Entry("9", "R_f %, largest, standing, guided", "6.56", ("size", "both/huge, apex-paper, one sample"),
          ("size", "both/huge, apex"), "R_f", f"the first sample of `apex-paper`; {LARGEST}"),
    Entry("9", "the same, unguided", "67.19", ("size", "both/huge, apex-paper, unguided, one sample"),
          ("size", "both/huge, apex's model alone, unguided"), "R_f",
          "the column `apex` has its model without trees and repair"),
    Entry("9", "R_f %, largest, standing, told sizes, guided", "", ("size", "both/huge, apex-paper-sizes, one sample"),
          (), "R_f", "not in the paper: the same network with the obstacles' sizes; what a point cannot tell"),
    Entry("9", "the same, unguided", "", ("size", "both/huge, apex-paper-sizes, unguided, one sample"), (), "R_f",
          "the same"),
    Entry("9", "R_f %, largest, standing, sampled until valid, guided", "(6.56)", ("size", "both/huge, apex-paper"), (),
          "R_f", "the paper does not say that a path is drawn again before it is executed"),
    Entry("9", "the same, unguided", "(67.19)", ("size", "both/huge, apex-paper, unguided"), (), "R_f", "the same"),
    Entry("9", "R_f %, largest, brought in, guided", "9.36", ("imposed", "sizes", "huge, apex-paper"),
          ("imposed", "sizes", "huge, apex"), "R_f", "the paper's protocol as we read it; replans are charged"),
    Entry("9", "the same, unguided", "98.45", ("imposed", "sizes", "huge, apex-paper, unguided"), (), "R_f",
          "`apex` has no unguided loop"),
    Entry("9", "R_f %, largest, passing, guided", "(9.36)", ("dynamic", "sizes", "huge, apex-paper"),
          ("dynamic", "sizes", "huge, apex"), "R_f",
          f"{CUBE}: while a plan is made, the cube moves on and reaches a robot at rest"),
    Entry("9", "the same, unguided", "(98.45)", ("dynamic", "sizes", "huge, apex-paper, unguided"), (), "R_f",
          "`apex` has no unguided loop"),
    Entry("9", "R_f %, largest, passing, replans take no time", "(9.36)",
          ("dynamic", "sizes", "huge, apex-paper, ideal"), ("dynamic", "sizes", "huge, apex, ideal"), "R_f",
          "as if the cube waited while the robot plans"),
    Entry("9", "the same, unguided", "(98.45)", ("dynamic", "sizes", "huge, apex-paper, unguided, ideal"), (), "R_f",
          "the same"),
    Entry("10b", "FID, guided", "21.51", ("fid", "VAE, apex-paper"), ("fid", "VAE, apex"), "fid",
          "N, dimension and features of the paper are not given, so that values cannot be compared, only their order"),
    Entry("10b", "FID, unguided", "48.63", ("fid", "VAE, apex-paper, unguided"), ("fid", "VAE, apex, unguided"), "fid",
          "the order is reversed; our guidance makes paths longer (`benchmarks/results/guidance.md`)"),
    Entry("IV-D", "time of a plan s, guided", "8.36", ("time", "apex-paper"), ("time", "apex"), "time_s",
          "median; CPU, the paper's a GPU; `apex-paper` samples one path after the other in 256 steps each"),
    Entry("IV-D", "time of a plan s, unguided", "19.63", ("time", "apex-paper, unguided"),
          ("time", "apex's model alone, unguided"), "time_s",
          "guidance costs time for a sample, and saves samples that fail; `apex` as above"),
)  # fmt: skip


@dataclass(frozen=True)
class Rival:
    """An algorithm that the paper compares with.

    Attributes:
        name: Its name in the paper, with the row's where there are several.
        ratio: The paper's R_f [%].
        smoothness: The paper's S_r.
        static: Our row in static scenes.
        moving: Our row in the closed loop, if there is one.
        differs: What differs, and why.
    """

    name: str
    ratio: str
    smoothness: str
    static: str
    moving: str
    differs: str


RIVALS = (
    Rival("APEX", "5.57, 8.95", "2.36", "apex-paper", "apex-paper", "sampled until a path is valid, for 60 s"),
    Rival("APEX", "", "", "apex", "apex", "this planner: network, trees, repair, full check"),
    Rival("RRT", "48.12", "8.72", "rrt", "", "OMPL's, no candidate beats its defaults; 10 s, simplified"),
    Rival("RRT", "", "", "drrt", "drrt", "a tree from the goal that is kept and repaired"),
    Rival("RRT", "", "", "rrtconnect", "rrtconnect", "not in the paper; range 1 rad, tuned; in the loop from rest"),
    Rival("RRT", "", "", "rrtconnect, OMPL's range", "", "not in the paper"),
    Rival("GPMP", "39.26", "6.87", "gpmp", "gpmp", "gradient descent on the Gaussian process prior, from a line"),
    Rival("GPMP", "", "", "gpmp2", "gpmp2", "not in the paper: its successor, least squares"),
    Rival("IL", "25.79", "5.23", "il", "il", "a transformer that sees all cubes; rolled out, unrepaired"),
    Rival("IL", "", "", "il-paper", "il-paper", "the same with one obstacle point, as the paper's condition"),
    Rival("IL", "", "", "il, repaired", "", "a control: the same, then trajectory optimization"),
    Rival("DAMON", "32.65", "6.25", "damon", "damon", "made from its abstract; states decoded from eight dimensions"),
    Rival("DAMON", "", "", "damon, 2 dimensions", "", "the same from a plane"),
    Rival("DAMON", "", "", "damon, 4 dimensions", "", "the same from four"),
    Rival("DAMON", "", "", "damon, stored", "", "the states that were encoded, and none decoded"),
)
