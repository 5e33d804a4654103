"""The engine: a model's equations of motion as machine code for this processor.

From JAX's language ([`translate`][hdjax.engine.translate]) to a graph of scalars ([`graph`][hdjax.engine.graph]), whose
[`derivatives`][hdjax.engine.derivatives] are sparse, to vector code ([`emission`][hdjax.engine.emission]) with a
Runge-Kutta method around it ([`march`][hdjax.engine.march] with derivatives, for fits;
[`transient`][hdjax.engine.transient] without, for sweeps).
"""

from hdjax.engine.array_rules import UntranslatableError as UntranslatableError
from hdjax.engine.kernel import Kernel as Kernel
from hdjax.engine.kernel import Lanes as Lanes
from hdjax.engine.kernel import Marched as Marched
from hdjax.engine.kernel import kernel as kernel
from hdjax.engine.kernel import march_lanes as march_lanes
from hdjax.engine.kernel import one_thread as one_thread
from hdjax.engine.kernel import threads as threads
from hdjax.engine.kernel import unusable as unusable
