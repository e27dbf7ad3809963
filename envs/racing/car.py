"""A car in the plane: a rigid body on two axles, whose tyres hold up to a limit.

    slip   = atan(v_side / (|v_long| + EASE)),   of each axle, in the direction of its wheels
    F_side = -STIFFNESS slip
    F_long = gas POWER / (|v_long| + ENGINE_EASE)        at the rear axle alone
             - brake GRIP clip(v_long / BRAKE_EASE)      at both
    |(F_long, F_side)| is cut to grip GRIP, where grip is 1 on the road and OFF_ROAD beside it

Source: the single-track model with a circle of friction, as in Rajamani (2012), "Vehicle Dynamics and
Control", chapters 2 and 4. Sizes, mass, inertia, grip, power and the speed of the steering are those
of Gymnasium's car in Box2D, read in m, kg and s. So the tyres hold 22 g, as a toy's do, and a lap fits
into 1000 steps, as there.
Differs from it: wheels roll without slip along their direction. The axles are at equal distances from
the centre of mass. A drag limits the speed to 100 m/s.
"""

import flax.struct
import jax
import jax.numpy as jnp

DT = 0.02  # s, a step
SUBSTEPS = 8
MASS = 7.3  # kg
AXLE = 1.62  # m, from the centre of mass to each axle
SIDE = 1.1  # m, from the middle to each wheel
INERTIA = MASS * AXLE**2  # kg m^2, to 1% that of Box2D's polygons
WHEEL = 0.54  # m, the radius of a wheel
GRIP = 800.0  # N, the most that the two tyres of an axle hold
OFF_ROAD = 0.6  # of it, beside the road
POWER = 80_000.0  # W
DRAG = 0.08  # N s^2/m^2; ours: GRIP / (100 m/s)^2
MAX_STEER = 0.4  # rad
STEER_SPEED = 3.0  # rad/s
GAS_STEP = 0.1  # the most that gas grows in a step
STIFFNESS = 4000.0  # N/rad, of an axle; ours: it slides from 0.2 rad on
# m/s, for what is undefined at rest
EASE = 5.0
ENGINE_EASE = 2.7  # Box2D's
BRAKE_EASE = 1.0


@flax.struct.dataclass
class Car:
    """The state of a car.

    position, velocity: [2], m and m/s. heading: rad, anticlockwise from x. spin: its rate, rad/s.
    steer: the angle of the front wheels, rad, positive to the left. gas: in [0, 1].
    """

    position: jax.Array
    heading: jax.Array
    velocity: jax.Array
    spin: jax.Array
    steer: jax.Array
    gas: jax.Array


def parked(position: jax.Array, heading: jax.Array) -> Car:
    zero = jnp.zeros(())
    return Car(position, heading, jnp.zeros(2), zero, zero, zero)


def rotated(vector: jax.Array, angle: jax.Array) -> jax.Array:
    """Vectors [..., 2], turned anticlockwise."""
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return jnp.stack([cos * x - sin * y, sin * x + cos * y], -1)


def length(vector: jax.Array) -> jax.Array:
    """Of vectors [..., 2]. The gradient is finite at 0, too."""
    return jnp.sqrt(jnp.square(vector).sum(-1) + 1e-12)


def axles(car: Car) -> tuple[jax.Array, jax.Array]:
    """Velocities of the front and the rear axle in the car's frame [2, 2], m/s, and the angles of their
    wheels [2], rad."""
    velocity = rotated(car.velocity, -car.heading)
    lever = jnp.array([AXLE, -AXLE])
    velocity = velocity + jnp.stack([jnp.zeros(2), car.spin * lever], 1)
    return velocity, jnp.stack([car.steer, jnp.zeros(())])


def wheels(car: Car) -> jax.Array:
    """Where the wheels are [4, 2], m: front left, front right, rear left, rear right."""
    places = jnp.array([[AXLE, SIDE], [AXLE, -SIDE], [-AXLE, SIDE], [-AXLE, -SIDE]])
    return car.position + rotated(places, car.heading)


def rolling(car: Car) -> jax.Array:
    """How fast the wheels turn [4], rad/s, in the order of `wheels`."""
    velocity, angle = axles(car)
    left = velocity.at[:, 0].add(-SIDE * car.spin)
    right = velocity.at[:, 0].add(SIDE * car.spin)
    both = jnp.stack([left, right], 1)  # [axle, side, 2]
    return rotated(both, -angle[:, None])[..., 0].reshape(4) / WHEEL


def forces(car: Car, brake: jax.Array, grip: jax.Array) -> jax.Array:
    """Of the tyres of the front and the rear axle, in the car's frame [2, 2], N."""
    velocity, angle = axles(car)
    along, side = jnp.moveaxis(rotated(velocity, -angle), -1, 0)
    engine = jnp.array([0.0, 1.0]) * car.gas * POWER / (jnp.abs(along) + ENGINE_EASE)
    push = engine - brake * GRIP * jnp.clip(along / BRAKE_EASE, -1.0, 1.0)
    hold = -STIFFNESS * jnp.arctan(side / (jnp.abs(along) + EASE))
    wanted = jnp.stack([push, hold], -1)
    held = jnp.minimum(1.0, grip * GRIP / length(wanted))
    return rotated(wanted * held[:, None], angle)


def drive(car: Car, steer: jax.Array, gas: jax.Array, brake: jax.Array, grip: jax.Array) -> Car:
    """One step of `DT`, in semi-implicit substeps.

    Args:
        steer: where the front wheels are to stand, in [-1, 1] of `MAX_STEER`, positive to the left.
        gas, brake: in [0, 1]. Gas grows slowly and falls at once.
        grip: [2], of the front and the rear axle: 1 on the road.
    """
    dt = DT / SUBSTEPS
    car = car.replace(gas=jnp.minimum(gas, car.gas + GAS_STEP))
    for _ in range(SUBSTEPS):
        turn = jnp.clip(steer * MAX_STEER - car.steer, -STEER_SPEED * dt, STEER_SPEED * dt)
        car = car.replace(steer=car.steer + turn)
        force = forces(car, brake, grip)
        drag = -DRAG * length(car.velocity) * car.velocity
        velocity = car.velocity + dt / MASS * (rotated(force.sum(0), car.heading) + drag)
        spin = car.spin + dt / INERTIA * AXLE * (force[0, 1] - force[1, 1])
        car = car.replace(
            position=car.position + dt * velocity,
            heading=car.heading + dt * spin,
            velocity=velocity,
            spin=spin,
        )
    return car
