"""JuPedSim: a crowd under the social force model of Helbing, Farkas and Vicsek (2000), in C++."""

import random

from turns import Case, run

PEOPLE, WIDTH, LENGTH = 1000, 32.0, 300.0  # m


def corridor(threads: int) -> Case:
    """A thousand people walk down a corridor, one per square metre at first."""
    import jupedsim

    walls = [(0, 0), (LENGTH, 0), (LENGTH, WIDTH), (0, WIDTH)]
    simulation = jupedsim.Simulation(model=jupedsim.SocialForceModel(), geometry=walls, dt=0.01)
    goal = simulation.add_waypoint_stage((LENGTH - 5, WIDTH / 2), 1)
    journey = simulation.add_journey(jupedsim.JourneyDescription([goal]))
    jitter = random.Random(0)  # noqa: S311  # not a secret
    for k in range(PEOPLE):
        at = tuple(1.0 + c * (WIDTH - 2) / 32 + jitter.uniform(-0.1, 0.1) for c in divmod(k, 32))
        simulation.add_agent(jupedsim.SocialForceModelAgentParameters(position=at, journey_id=journey, stage_id=goal))
    does = (
        f"social force model, one crowd of {PEOPLE} people, 1 per m2 at first, float64, dt 0.01 s: repulsion, "
        "body force and friction within 2.5 m, walls, way finding; no observations, no rewards"
    )
    return Case(simulation.iterate, PEOPLE, does)


if __name__ == "__main__":
    run({"crowd": corridor}, "jupedsim")
