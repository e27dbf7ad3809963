"""A physics step of engine `warp` in four kernels, and a few of MuJoCo Warp's for what they leave out.

    dynamics      from positions and velocities to the forces without constraints: dynamics.cu
    constraints   where geoms touch, and limits of joints: constraints.py
    lists         of the contacts of each world: solver.py
    end           accelerations by the solver, and with them the next state: newton.cu, advance.cu

With a few thousand worlds or fewer the number of kernels sets the pace. MuJoCo Warp takes some 50 of a
few microseconds each for the first alone, for robots of 4 to 30 bodies. Here 8, 16 or 32 threads share
a world and keep what they compute in shared memory. Where an H200 holds all worlds at a time, and all
contacts have formulas and rows, the passes of several steps are one kernel. With more worlds kernels
apart are faster: together they are longer than what a multiprocessor keeps of a program.

Equalities, dry friction, limits of ball joints and collisions of meshes and of convex shapes without a
formula are MuJoCo Warp's. Sensors are `sensors.py`.

Of `Data` only what later kernels and this project read is written: no `qacc_smooth`, no parts of
`qfrc_smooth`, no inertial frames, cameras, lights or energy. A pass whose sensors read more is MuJoCo
Warp's. Forces are those of gravity, springs, dampers, actuators and fluids: `xfrc_applied` and
`qfrc_applied` count nothing. A fluid sees a body as the box of its inertia, never as ellipsoids. The
rates of axes in equalities are those of the state, as in MuJoCo; MuJoCo Warp's are of the state before.

Source: MuJoCo's documentation, Computation; Featherstone (2008), Rigid Body Dynamics Algorithms.
"""
# Kernels are Warp's language in Python's syntax, which no type checker of Python knows:
# pyright: reportIndexIssue=false, reportAssignmentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportReturnType=false, reportInvalidTypeForm=false

import dataclasses
import functools
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp

from jaxsafe.envs.engines.warp import constraints, sensors, solver
from jaxsafe.envs.engines.warp.constraints import Geoms, Joints, Lists, own
from jaxsafe.envs.engines.warp.recording import Recording
from jaxsafe.envs.engines.warp.solver import REGISTERS, THREADS, Listing, Problem, enlist, threads

EULER, RK4 = mujoco_warp.IntegratorType.EULER, mujoco_warp.IntegratorType.RK4
SHARED_MEMORY = 47 * 1024  # bytes of a block; Warp takes one more KiB
SHARED_AT_THE_END = 8 * 1024  # bytes, at most, of newton.cu and advance.cu
vec10 = wp.types.vector(length=10, dtype=float)
HERE = Path(__file__)
DYNAMICS, LANES, ADVANCE = (
    HERE.with_name(f"{name}.cu").read_text() for name in ("dynamics", "lanes", "advance")
)
KINDS = ", ".join(f"{kind.name} = {int(kind)}" for kind in mujoco_warp.JointType)
FULL = ", ".join(f"NO_{kind.name} = {int(kind)}" for kind in mujoco_warp.OverflowType)
ENUMS = (
    f"constexpr int {KINDS}, {FULL}, "
    f"ON_SITE = {int(mujoco_warp.TrnType.SITE)}, AFFINE = {int(mujoco_warp.BiasType.AFFINE)};\n"
)
READABLE = [  # sensors that need nothing which is not written
    int(getattr(mujoco.mjtSensor, f"mjSENS_{name}"))
    for name in (
        "TOUCH", "ACCELEROMETER", "VELOCIMETER", "GYRO", "FORCE", "TORQUE", "MAGNETOMETER",
        "RANGEFINDER", "JOINTPOS", "JOINTVEL", "BALLQUAT", "BALLANGVEL", "JOINTLIMITPOS",
        "JOINTLIMITVEL", "JOINTLIMITFRC", "GEOMDIST", "GEOMNORMAL", "GEOMFROMTO", "CONTACT", "CLOCK",
    )
]  # fmt: skip
OF_LIMITS = [
    int(getattr(mujoco.mjtSensor, f"mjSENS_JOINTLIMIT{what}")) for what in ("POS", "VEL", "FRC")
]
UNWRITTEN = {"qfrc_actuator", "cfrc_ext"}  # fields that are not written
STAY = wp.constant(-1)  # no stage of the integrator
NO_CONTACTS = wp.constant(int(mujoco_warp.OverflowType.NARROWPHASE))


@wp.struct
class System:
    # the model
    levels: int
    body_level: wp.array[int]  # ours: how far from the world
    body_end: wp.array[int]  # ours: after the last body that it carries
    body_deepest: wp.array[int]  # ours: the last degree of freedom that moves it, or -1
    body_parentid: wp.array[int]
    body_rootid: wp.array[int]
    body_mocapid: wp.array[int]
    body_jntnum: wp.array[int]
    body_jntadr: wp.array[int]
    body_pos: wp.array2d[wp.vec3]
    body_quat: wp.array2d[wp.quat]
    body_ipos: wp.array2d[wp.vec3]
    body_iquat: wp.array2d[wp.quat]
    body_mass: wp.array2d[float]
    body_inertia: wp.array2d[wp.vec3]
    body_subtreemass: wp.array2d[float]
    jnt_type: wp.array[int]
    jnt_qposadr: wp.array[int]
    jnt_dofadr: wp.array[int]
    jnt_pos: wp.array2d[wp.vec3]
    jnt_axis: wp.array2d[wp.vec3]
    jnt_stiffness: wp.array2d[float]
    qpos0: wp.array2d[float]
    qpos_spring: wp.array2d[float]
    dof_before: wp.array[int]  # ours: the last degree of freedom that moves its axis, or -1
    dof_bodyid: wp.array[int]
    dof_jntid: wp.array[int]
    dof_parentid: wp.array[int]
    dof_armature: wp.array2d[float]
    dof_damping: wp.array2d[float]
    M_rownnz: wp.array[int]
    M_rowadr: wp.array[int]
    begin: wp.array[int]  # where each row of M begins in `column` and `place`
    column: wp.array[int]
    place: wp.array[int]  # in M
    geom_moves: wp.array[int]  # ours
    geom_bodyid: wp.array[int]
    geom_pos: wp.array2d[wp.vec3]
    geom_quat: wp.array2d[wp.quat]
    site_bodyid: wp.array[int]
    site_pos: wp.array2d[wp.vec3]
    site_quat: wp.array2d[wp.quat]
    actuator_trntype: wp.array[int]
    actuator_trnid: wp.array[wp.vec2i]
    actuator_gear: wp.array2d[wp.spatial_vector]
    actuator_gainprm: wp.array2d[vec10]
    actuator_biastype: wp.array[int]
    actuator_biasprm: wp.array2d[vec10]
    actuator_ctrllimited: wp.array[bool]
    actuator_ctrlrange: wp.array2d[wp.vec2]
    actuator_forcelimited: wp.array[bool]
    actuator_forcerange: wp.array2d[wp.vec2]
    gravity: wp.array[wp.vec3]
    timestep: wp.array[float]
    density: wp.array[float]
    viscosity: wp.array[float]
    wind: wp.array[wp.vec3]
    # the worlds
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    ctrl: wp.array2d[float]
    mocap_pos: wp.array2d[wp.vec3]
    mocap_quat: wp.array2d[wp.quat]
    xpos: wp.array2d[wp.vec3]
    xquat: wp.array2d[wp.quat]
    xmat: wp.array2d[wp.mat33]
    geom_xpos: wp.array2d[wp.vec3]
    geom_xmat: wp.array2d[wp.mat33]
    site_xpos: wp.array2d[wp.vec3]
    site_xmat: wp.array2d[wp.mat33]
    subtree_com: wp.array2d[wp.vec3]
    cinert: wp.array2d[vec10]
    cvel: wp.array2d[wp.spatial_vector]
    cdof: wp.array2d[wp.spatial_vector]
    cdof_dot: wp.array2d[wp.spatial_vector]
    M: wp.array2d[float]
    qfrc_smooth: wp.array2d[float]
    qacc: wp.array2d[float]
    Ma: wp.array2d[float]
    qacc_warmstart: wp.array2d[float]
    time: wp.array[float]
    # ours, of Runge and Kutta's step: where it began, and the means of its stages so far
    start_qpos: wp.array2d[float]
    start_qvel: wp.array2d[float]
    mean_qvel: wp.array2d[float]
    mean_qacc: wp.array2d[float]
    ne: wp.array[int]
    nf: wp.array[int]
    nl: wp.array[int]
    nefc: wp.array[int]
    count: wp.array[int]  # of the solver: contacts
    nacon: wp.array[int]
    ncollision: wp.array[int]
    overflow: wp.array[int]
    rows: int
    contacts: int


def shared_size(bodies: int, joints: int, dofs: int, actuators: int) -> int:
    """Floats of a world in shared memory, which dynamics.cu divides up and holds to this."""
    return 33 * bodies + 6 * joints + 13 * dofs + actuators


@functools.cache
def dynamics_function(sizes: tuple[int, ...], fluid: bool, lanes: int, worlds: int) -> Any:
    bodies, joints, dofs, actuators = sizes
    constants = (
        f"BODIES = {bodies}, JOINTS = {joints}, DOFS = {dofs}, ACTUATORS = {actuators}, "
        f"FLUID = {int(fluid)}, LANES = {lanes}, WORLDS = {worlds}, SHARED = {shared_size(*sizes)}"
    )

    @wp.func_native(f"constexpr int {constants};\n{ENUMS}{DYNAMICS}")
    def dynamics(p: System, for_sensors: bool, block: int, thread: int): ...

    return dynamics


@functools.cache
def dynamics_kernel(sizes: tuple[int, ...], fluid: bool, lanes: int, worlds: int) -> Any:
    dynamics = dynamics_function(sizes, fluid, lanes, worlds)

    @wp.kernel(module="unique", enable_backward=False)
    def kernel(p: System, for_sensors: bool):
        block, thread = wp.tid()
        dynamics(p, for_sensors, block, thread)

    return kernel


@functools.cache
def advance_function(nv: int, damped: bool, euler: bool, lanes: int, worlds: int) -> Any:
    constants = (
        f"NV = {nv}, DAMPED = {int(damped)}, EULER = {int(euler)}, LANES = {lanes}, WORLDS = {worlds}"
    )

    @wp.func_native(f"constexpr int {constants};\n{ENUMS}{LANES}{ADVANCE}")
    def advance(p: System, stage: int, world: int, thread: int): ...

    return advance


@functools.cache
def end_kernel(nv: int, room: int, damped: bool, euler: bool, lanes: int, worlds: int) -> Any:
    """Of a pass: the solver, and unless `stage` is STAY a stage of the integrator."""
    newton = solver.newton_function(nv, room, lanes, worlds)
    advance = advance_function(nv, damped, euler, lanes, worlds)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=REGISTERS)
    def kernel(problem: Problem, p: System, stage: int):
        block, thread = wp.tid()
        world = block * worlds + thread // lanes
        if world >= p.qpos.shape[0]:
            return
        newton(problem, world, thread)
        if stage != STAY:
            advance(p, stage, world, thread)

    return kernel


@wp.func_native("""
#if defined(__CUDA_ARCH__)
__syncwarp();
#else
WP_TILE_SYNC();
#endif
""")
def sync(): ...


@wp.struct
class Guides:
    """Mocap bodies that go round, see `Simulation.orbits`."""

    base: wp.array2d[wp.vec3]
    orbits: wp.array[float]
    done: wp.array2d[float]
    substeps: wp.array2d[float]
    timestep: float
    mocap_pos: wp.array2d[wp.vec3]


@wp.func
def go_round(p: Guides, k: int, world: int, body: int):
    """Where they are at substep k, as `simulation.mocap_at` has them."""
    if float(k) < p.substeps[world, 0]:
        time = (p.done[world, 0] + float(k)) * p.timestep
        circle = wp.vec3(wp.sin(time), wp.cos(time), 0.0)
        p.mocap_pos[world, body] = p.base[world, body] + p.orbits[body] * circle


@functools.cache
def passes_kernel(dynamics: Any, look: Any, newton: Any, advance: Any, lanes: int) -> Any:
    """All passes of a world, one after the other. A world is a block."""

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=REGISTERS)
    def kernel(
        problem: Problem,
        p: System,
        geoms: Geoms,
        joints: Joints,
        lists: Lists,
        listing: Listing,
        guides: Guides,
        looks: int,
        steps: int,
        stages: int,  # of a step
        passes: int,  # those of the steps, and maybe one more that stays
    ):
        world, lane = wp.tid()
        mine, room = own(lists, world), lists.dist.shape[1]
        for k in range(passes):
            moves = k < steps * stages
            if moves and k % stages == 0:
                for body in range(lane, guides.orbits.shape[0], lanes):
                    go_round(guides, k // stages, world, body)
            if lane == 0:
                mine.count[0] = 0
            sync()
            dynamics(p, not moves, world, lane)
            sync()
            for i in range(lane, looks, lanes):
                look(i, world, geoms, joints, mine)
            sync()
            contacts = wp.min(mine.count[0], room)
            for i in range(lane, contacts, lanes):
                enlist(listing, world * room + i, world)
            if lane == 0 and mine.count[0] > room:
                p.overflow[world] = p.overflow[world] | NO_CONTACTS
            sync()
            newton(problem, world, lane)
            if moves:
                advance(p, k % stages, world, lane)
            sync()

    return kernel


@dataclasses.dataclass
class Plan:
    """Of the worlds of one `Data`."""

    system: Any
    sizes: tuple[int, int, int, int]  # bodies, joints, degrees of freedom, actuators
    fluid: bool
    damped: bool  # whether a step takes the forces of dampers at its end
    euler: bool
    plain_rows: Recording | None  # MuJoCo Warp's kernels for them; None: there are only limits of ours
    readable: bool  # whether its sensors, and the fields asked for, need nothing else
    constraints: constraints.Constraints | None  # None: contacts are MuJoCo Warp's
    sensors: sensors.Reader | None  # None: they are MuJoCo Warp's
    lists: Any  # of contacts, one for each world, where all passes are one kernel, else None


def tree(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """What dynamics.cu asks of the tree of bodies beyond MuJoCo's own fields."""
    parent, bodies = model.body_parentid, range(1, model.nbody)
    level, end = np.zeros(model.nbody, int), np.arange(model.nbody) + 1
    deepest = np.full(model.nbody, -1)
    for b in bodies:  # a parent comes before its children
        level[b] = level[parent[b]] + 1
        own = model.body_dofadr[b] + model.body_dofnum[b] - 1
        deepest[b] = own if model.body_dofnum[b] else deepest[parent[b]]
    for b in reversed(bodies):
        end[parent[b]] = max(end[parent[b]], end[b])
    first = model.jnt_dofadr[model.dof_jntid]
    of_free = model.jnt_type[model.dof_jntid] == mujoco_warp.JointType.FREE
    straight = of_free & (np.arange(model.nv) < first + 3)
    before = np.where(of_free, first + 2, model.dof_parentid[first])
    root = model.body_rootid[model.geom_bodyid]
    moves = (model.body_weldid[model.geom_bodyid] != 0) | (model.body_mocapid[root] >= 0)
    return {
        "body_level": level,
        "body_end": end,
        "body_deepest": deepest,
        "dof_before": np.where(straight, -1, before),
        "geom_moves": moves,
    }


def sizes_of(model: mujoco.MjModel) -> tuple[int, int, int, int]:
    """Bodies, joints, degrees of freedom, actuators."""
    return model.nbody, model.njnt, model.nv, model.nu


def uncovered(model: mujoco.MjModel, m: Any, d: Any) -> list[str]:
    """What the kernels are not for, in a few words each: they are for the integrators Euler and RK4,
    motors on joints and sites, linear springs and dampers, and what the solver is for."""
    joint, trn, off = mujoco_warp.JointType, mujoco_warp.TrnType, mujoco_warp.DisableBit
    bias_type, gain_type = mujoco_warp.BiasType, mujoco_warp.GainType
    turns = np.isin(model.jnt_type, (joint.FREE, joint.BALL))
    at = model.actuator_trnid[:, 0]
    on_joint = model.actuator_trntype <= trn.JOINTINPARENT  # the same for hinges and slides
    on_site = (model.actuator_trntype == trn.SITE) & (model.actuator_trnid[:, 1] < 0)
    bias = model.actuator_biastype
    motors = on_joint & ~turns[np.where(on_joint, at, 0)] & (bias <= bias_type.AFFINE)
    thrusters = on_site & (bias == bias_type.NONE)
    linear = (motors | thrusters).all() and (model.actuator_gaintype == gain_type.FIXED).all()
    shared = 4 * shared_size(*sizes_of(model)) * (THREADS // lanes_of(sizes_of(model)))
    names = (*System.vars, *constraints.Joints.vars)
    batched = [getattr(m, name) for name in names if hasattr(m, name)]
    batched = [x for x in batched if x.ndim == 2]
    batched += [m.opt.gravity, m.opt.density, m.opt.viscosity, m.opt.wind]
    stiff = m.jnt_stiffness.numpy()[0, turns].any()
    found = {
        "an integrator other than Euler and RK4": m.opt.integrator not in (EULER, RK4),
        "disabled features": m.opt.disableflags & ~int(off.SENSOR | off.NATIVECCD),
        "enabled features": m.opt.enableflags,
        "no collisions": not m.opt.run_collision_detection,
        "sensors of forces between bodies": m.opt.run_rne_postconstraint,
        "ellipsoids in a fluid": m.has_fluid and (model.geom_fluid[:, 0] > 0).any(),
        "tendons": model.ntendon,
        "actuators with a state or a delay": model.na or m.nhistory or m.nactuator != model.nu,
        "actuators that are no motors on joints or sites": not linear,
        "limits on the forces of actuators at joints": m.jnt_actfrclimited.numpy().any(),
        "compensated gravity": m.body_gravcomp.numpy().any(),
        "springs of ball joints": stiff,
        "springs or dampers that are not linear": (
            m.jnt_stiffnesspoly.numpy().any() or m.dof_dampingpoly.numpy().any()
        ),
        "callbacks": any(vars(m.callback).values()),
        "parameters that differ between worlds": any(x.shape[0] != 1 for x in batched),
        f"{model.nbody} bodies": shared > SHARED_MEMORY,
    }
    return [*solver.uncovered(m, d), *(name for name, is_so in found.items() if is_so)]


def adopt(
    model: mujoco.MjModel, m: Any, d: Any, upright: Sequence[str] = (), fields: Sequence[str] = ()
) -> bool:
    """Have `step` and `forward` run `d` here, unless something is `uncovered`.

    The solver may adopt `d` even so. The arrays of `m` and `d` are bound now, and options looked at:
    later only what is written into these arrays counts, and flags of sensors, contacts and the solver.

    Args:
        model: what `m` and `d` were made of.
        upright: the model's pillars, see `Simulation.pillars`.
        fields: what the last pass is to leave in `d`, see `Simulation.fields`.
    """
    solver.adopt(model, m, d)
    if uncovered(model, m, d):
        return False
    p, extra = System(), tree(model)
    for name, x in extra.items():
        setattr(p, name, wp.array(x, dtype=int, device=d.qacc.device))
    for name in System.vars:
        for owner in (m, m.opt, d, d.efc):
            if hasattr(owner, name):
                setattr(p, name, getattr(owner, name))
    p.levels = int(extra["body_level"].max()) + 1
    p.begin, p.column, p.place = m.M_mulm_rowadr, m.M_mulm_col, m.M_mulm_madr
    four = m.opt.integrator == RK4
    for name in ("start_qpos", "start_qvel", "mean_qvel", "mean_qacc"):
        shape = (d.nworld, model.nq if name == "start_qpos" else model.nv)
        setattr(p, name, wp.zeros(shape if four else (0, 0), dtype=float, device=d.qacc.device))
    p.count = d.newton.count
    others = model.neq or m.dof_frictionloss.numpy().any() or m.jnt_limited_ball_adr.size
    others = bool(others or np.isin(model.sensor_type, OF_LIMITS).any())
    found = constraints.adopt(model, m, d, upright, limits=not others)
    theirs = others or (found is None and m.jnt_limited_slide_hinge_adr.size > 0)
    lists = None
    fits = 4 * shared_size(*sizes_of(model)) + SHARED_AT_THE_END <= SHARED_MEMORY
    few = d.nworld <= solver.MANY
    # contacts without rows: the solver's lists are not made for their number
    rowless = model.geom_gap.any() or model.pair_gap.any() or m.nsensorcollision
    if found and found.by_formula and not theirs and few and fits and not rowless:
        widen(d)
        found = constraints.adopt(model, m, d, upright, limits=not others)
        lists = found.by_world(d.nworld) if found else None
    p.rows, p.contacts = d.njmax, d.naconmax
    d.dynamics = Plan(
        system=p,
        sizes=sizes_of(model),
        fluid=m.has_fluid,
        damped=not four and bool(m.dof_damping.numpy().any()),
        euler=not four,
        plain_rows=Recording(partial(solver.plain_rows, m, d)) if theirs else None,
        readable=bool(np.isin(model.sensor_type, READABLE).all()) and UNWRITTEN.isdisjoint(fields),
        constraints=found,
        sensors=sensors.adopt(model, m, d, p.body_deepest),
        lists=lists,
    )
    return True


def widen(d: Any) -> None:
    """Make room for as many contacts as the solver takes, in every world."""
    d.naconmax = d.nworld * d.newton.listed.shape[1]
    for field in dataclasses.fields(d.contact):
        x = getattr(d.contact, field.name)
        if x.size:
            shape = (d.naconmax, *x.shape[1:])
            setattr(d.contact, field.name, wp.zeros(shape, dtype=x.dtype, device=x.device))
    d.newton.soft = wp.zeros(d.naconmax, dtype=wp.vec3, device=d.qacc.device)


def lanes_of(sizes: tuple[int, ...]) -> int:
    """Threads of a world: 8, 16 or 32, at least half of its bodies and of its degrees of freedom."""
    lanes = 8
    while lanes < THREADS and 2 * lanes < max(sizes):
        lanes *= 2
    return lanes


def at_once(d: Any) -> bool:
    """Whether several steps are one kernel."""
    plan = getattr(d, "dynamics", None)
    return bool(plan and plan.lists)


def forward(m: Any, d: Any, steps: int = 0, guides: Any = None) -> None:
    """In place of MuJoCo Warp's, for data that was adopted.

    Args:
        steps: before it, if they are `at_once`.
        guides: mocap bodies that go round meanwhile, `Guides`.
    """
    plan = getattr(d, "dynamics", None)
    see = not m.opt.disableflags & mujoco_warp.DisableBit.SENSOR
    if plan and at_once(d) and (not see or (plan.readable and plan.sensors)):
        passes(m, d, steps, stay=True, guides=guides)
        if see:
            plan.sensors.read(d.nworld)
        return
    if steps:
        passes(m, d, steps, guides=guides)
    if plan is None or (see and not plan.readable):
        mujoco_warp.forward(m, d)
        return
    until_solved(m, d, see)
    if see and not plan.sensors:
        d.sensordata.zero_()
        mujoco_warp.sensor_pos(m, d)
        mujoco_warp.sensor_vel(m, d)
    end(m, d, STAY)
    if see and plan.sensors:
        plan.sensors.read(d.nworld)
    elif see:
        if m.sensor_rne_postconstraint:
            mujoco_warp.rne_postconstraint(m, d)
        mujoco_warp.sensor_acc(m, d, skip_rne_postconstraint=True)


def step(m: Any, d: Any) -> None:
    """In place of MuJoCo Warp's, for data that was adopted. Sensors are not read."""
    plan = getattr(d, "dynamics", None)
    if plan is None:
        mujoco_warp.step(m, d)
        return
    if plan.lists:
        passes(m, d, 1)
        return
    for stage in range(1 if d.dynamics.euler else 4):
        until_solved(m, d, False)
        end(m, d, stage)


def passes(m: Any, d: Any, steps: int, stay: bool = False, guides: Any = None) -> None:
    """Steps, and if asked a pass that stays, in one kernel."""
    plan, lanes = d.dynamics, solver.shape_of(m.nv, d)[0]
    stages, room = 1 if plan.euler else 4, d.newton.listed.shape[1]
    find = plan.constraints
    kernel = passes_kernel(
        dynamics_function(plan.sizes, plan.fluid, lanes, worlds=1),
        find.look,
        solver.newton_function(m.nv, room, lanes, worlds=1),
        advance_function(m.nv, plan.damped, plan.euler, lanes, worlds=1),
        lanes,
    )
    wp.launch_tiled(
        kernel,
        dim=d.nworld,
        inputs=[
            solver.problem(m, d),
            plan.system,
            find.geoms,
            find.joints,
            plan.lists,
            solver.listing(m, d),
            guides or Guides(),
            find.looks,
            steps,
            stages,
            steps * stages + stay,
        ],
        block_dim=lanes,
    )


def until_solved(m: Any, d: Any, for_sensors: bool) -> None:
    """All of a pass that comes before the solver."""
    plan = d.dynamics
    lanes = min(threads(d), lanes_of(plan.sizes))
    worlds = threads(d) // lanes  # of a block
    wp.launch_tiled(
        dynamics_kernel(plan.sizes, plan.fluid, lanes, worlds),
        dim=-(-d.nworld // worlds),
        inputs=[plan.system, for_sensors],
        block_dim=threads(d),
    )
    if plan.plain_rows:
        plan.plain_rows.repeat()
    if plan.constraints:
        plan.constraints.find(d.nworld)
    else:
        mujoco_warp.collision(m, d)
    solver.list_contacts(m, d)


def end(m: Any, d: Any, stage: int) -> None:
    """The solver, and a stage of the integrator, as advance.cu counts them, or STAY."""
    plan, (lanes, worlds) = d.dynamics, solver.shape_of(m.nv, d)
    wp.launch_tiled(
        end_kernel(m.nv, d.newton.listed.shape[1], plan.damped, plan.euler, lanes, worlds),
        dim=-(-d.nworld // worlds),
        inputs=[solver.problem(m, d), plan.system, stage],
        block_dim=lanes * worlds,
    )
