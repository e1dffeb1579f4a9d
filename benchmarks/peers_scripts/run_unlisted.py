"""One scene, in a process where nothing else was defined, or where one more effect was; for benchmarks.composition."""

import hashlib

from turns import Case, run

STEPS = 10


def plain(threads: int) -> Case:
    """The scene as it is."""
    from benchmarks.scenes import world

    scene = world("float32")
    start = scene.start(0, worlds=1024)
    state = scene.step(start, steps=100)
    digest = hashlib.sha256(state.x.tobytes() + state.v.tobytes()).hexdigest()[:16]
    counted = ", ".join(f"{state.count_of(what)} {what}" for what in ("evaluations", "neighbour_queries", "pairs"))
    does = f"100 steps: bits {digest}; {counted}"
    work = state.copy()

    def step() -> None:
        work.x[...], work.v[...] = start.x, start.v
        scene.step(work, out=work, steps=STEPS)

    return Case(step, 1024 * scene.agents * STEPS, does)


def another(threads: int) -> Case:
    """The same, once all effects were imported and one more was defined, in another scene used too."""
    from typing import Any, ClassVar, Literal

    import flockenv.physics.effects
    from benchmarks.scenes import world
    from flockenv.jit.decorators import Law, Vec, law
    from flockenv.maths.vectors import zero
    from flockenv.physics.effects import Effect

    @law
    def nowhere(p: Any, me: Any) -> Vec:
        return zero(me.pos)

    class Unasked(Effect):
        kind: Literal["unasked"] = "unasked"
        strength: float = 1.0
        own_law: ClassVar[Law | None] = nowhere

    assert "unasked" in flockenv.physics.effects.EFFECTS
    busy = world("float32").with_effects(*world("float32").effects[:1])
    busy.step(busy.start(0))
    return plain(threads)


if __name__ == "__main__":
    run({"plain": plain, "another": another}, "flockenv")
