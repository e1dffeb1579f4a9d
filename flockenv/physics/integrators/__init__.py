"""Integrators, one method per file; a new one needs a file, and a row in tests/catalogue.py."""

from __future__ import annotations

from flockenv.jit.startup import import_all

import_all(__name__, __path__)

from flockenv.physics.integrators.adaptive import Adaptive  # noqa: E402  # after the folder has been walked
from flockenv.physics.integrators.adaptive_rk4 import AdaptiveRK4  # noqa: E402
from flockenv.physics.integrators.averaged_velocity import AveragedVelocity  # noqa: E402
from flockenv.physics.integrators.dormand_prince import DormandPrince  # noqa: E402
from flockenv.physics.integrators.explicit_euler import ExplicitEuler  # noqa: E402
from flockenv.physics.integrators.exponential_drag import ExponentialDrag  # noqa: E402
from flockenv.physics.integrators.heun import Heun  # noqa: E402
from flockenv.physics.integrators.implicit import Implicit  # noqa: E402
from flockenv.physics.integrators.implicit_euler import ImplicitEuler  # noqa: E402
from flockenv.physics.integrators.implicit_midpoint import ImplicitMidpoint  # noqa: E402
from flockenv.physics.integrators.integrator import INTEGRATORS, Integrator, methods_of  # noqa: E402
from flockenv.physics.integrators.linearly_implicit_euler import LinearlyImplicitEuler  # noqa: E402
from flockenv.physics.integrators.midpoint import Midpoint  # noqa: E402
from flockenv.physics.integrators.rk4 import RK4  # noqa: E402
from flockenv.physics.integrators.semi_implicit_euler import SemiImplicitEuler  # noqa: E402
from flockenv.physics.integrators.velocity_verlet import VelocityVerlet  # noqa: E402

__all__ = [
    "INTEGRATORS", "RK4", "Adaptive", "AdaptiveRK4", "AveragedVelocity", "DormandPrince", "ExplicitEuler",
    "ExponentialDrag", "Heun", "Implicit", "ImplicitEuler", "ImplicitMidpoint", "Integrator",
    "LinearlyImplicitEuler", "Midpoint", "SemiImplicitEuler", "VelocityVerlet", "methods_of",
]  # fmt: skip
