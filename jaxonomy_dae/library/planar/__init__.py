"""Planar mechanics: rigid bodies, joints and forces in a plane.

Conventions, those of Modelica's planar and multibody libraries (Otter, Elmqvist & Cellier 1996, "Modeling of multibody
systems with the object-oriented modeling language Dymola", Nonlinear Dynamics 9:91; Zimmer 2012, "A planar mechanical
library for teaching Modelica"): a frame has an absolute position `x`, `y` in metre, an angle `phi` in radian from the
world's x axis, counter-clockwise, and a force `fx`, `fy` in newton along the world's axes and a torque `tau` in newton
metre, counted positive into the component. Angles are not wrapped: a frame that turned twice has phi = 4π.

A mechanism is Newton's and Euler's equations with the joints' constraints beside them, as in Haug 1989, "Computer Aided
Kinematics and Dynamics of Mechanical Systems", chapters 2, 3 and 6. Loops are closed by connecting frames. The forces
in joints must be determined, so parts that are held twice in the same way (two pins between the same two bodies, a
third bar in a parallelogram) are refused, by name: take one out, or let one yield, with a `SpringDamper`.

By default all positions and speeds are states, and are projected onto the constraints. In a chain that is not closed,
the bodies' angles are a minimal set that is good in every position, smaller and faster:

```python
AcausalCompiler(ev, diagram, state_selection="dummy_derivatives", prefer_states=["rod.body.phi", "rod.body.omega"])
```
"""

from .bodies import Body as Body
from .bodies import Link as Link
from .bodies import MassiveLink as MassiveLink
from .bodies import World as World
from .forces import Force as Force
from .forces import SpringDamper as SpringDamper
from .forces import String as String
from .forces import Torque as Torque
from .joints import Prismatic as Prismatic
from .joints import Revolute as Revolute
from .pendulum import PlanarPendulum as PlanarPendulum
from .sensors import AbsoluteSensor as AbsoluteSensor
from .sensors import RelativeSensor as RelativeSensor
