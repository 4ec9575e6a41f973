"""Good simulated surveys, all diagnosed though nothing is wrong with them: how many are blamed?

``python -m tests.acceptance.innocent_surveys 200 [FIRST_SEED]`` prints that; the adjustment asks for a diagnosis only
where the global test fails, so that this is harder than what a user meets.
"""

import sys

from tests.acceptance.planted_mistakes import diagnosed
from tests.acceptance.planted_surveys import survey_of

FAST = ("stereo", "rig", "tripods", "held lens", "relay", "hand", "base", "hall", "plane", "poses")


def main() -> None:
    number, first, blamed = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1000, 0
    for i in range(number):
        kind, seed = FAST[i % len(FAST)], first + i
        found = diagnosed(survey_of(kind, seed)[0]).candidates
        blamed += bool(found)
        if found:
            print(f"{kind}, seed {seed}: {found[0].hypothesis.cause}", flush=True)
        if i % 20 == 19:
            print(f"{blamed} of {i + 1} blamed", flush=True)


if __name__ == "__main__":
    main()
