"""MuJoCo's Newton solver for engine `warp`, with all iterations of a world in one kernel.

    minimise_x  (x - x0)' M (x - x0) / 2 + sum_r s_r(J_r x - aref_r)

x: accelerations, x0: those without constraints, s_r: the cost of row r, convex and quadratic in pieces.
An iteration solves H d = -g with the gradient g and the Hessian H = M + J' diag(s'') J, and goes along
d to where the slope vanishes. Iterations end where g' H^-1 g, the gain of a further one, is small.

A contact has up to 10 rows, but all are linear in 6 numbers, the relative motion (*twist*) of its two
bodies at one point; and a box on the floor has 20 contacts. So the rows of contacts are never formed. A
*pair* of touching bodies has 6 rows, E, a contact a small matrix C and the curvature S of its cost, and

    H = M + sum over pairs of E' (sum over its contacts of C' S C) E

and likewise forces and slopes. Limits, equalities and dry friction, the *plain* rows, are as MuJoCo
Warp makes them. That writes all of J and launches ten kernels an iteration for all worlds until the
last has converged; here a warp of threads, or half of one, stays with one world until that has.

Of a contact's rows `efc.force` alone is written, `efc.state` is not, and the flag of a solve that is
cut short is set without a printed line.

Source: Todorov (2014), "Convex and analytically-invertible dynamics with contacts and constraints",
and MuJoCo's documentation, Computation.
"""
# Kernels are Warp's language in Python's syntax, which no type checker of Python knows:
# pyright: reportIndexIssue=false, reportAssignmentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportReturnType=false, reportInvalidTypeForm=false

import dataclasses
import functools
from pathlib import Path
from typing import Any

import mujoco
import warp as wp
from mujoco.mjx.third_party import mujoco_warp
from mujoco.mjx.third_party.mujoco_warp._src import constraint, types

THREADS = 32  # of a block: a warp
REGISTERS = 128  # of a thread, for 16 blocks a multiprocessor
HALF = 16  # threads of a world, of many whose robots have no more degrees of freedom
MANY = 2048  # worlds: of more an H200 does not hold all at a time, if each is a block
MOST = 32  # degrees of freedom: beyond them MuJoCo Warp's J is sparse

theirs = mujoco_warp.solve
their_constraints = mujoco_warp.make_constraint
vec5 = wp.types.vector(length=5, dtype=float)
SOURCE = "".join(Path(__file__).with_name(name).read_text() for name in ("lanes.cu", "newton.cu"))


@wp.struct
class Listing:
    """Contacts as they were found, and where they are listed."""

    disableflags: int
    timestep: wp.array[float]
    impratio_invsqrt: wp.array[float]
    body_invweight0: wp.array2d[wp.vec2]
    geom_bodyid: wp.array[int]
    type: wp.array[int]
    geom: wp.array[wp.vec2i]
    dim: wp.array[int]
    dist: wp.array[float]
    includemargin: wp.array[float]
    friction: wp.array[vec5]
    solref: wp.array[wp.vec2]
    solimp: wp.array[vec5]
    worldid: wp.array[int]
    room: int  # for rows
    nefc: wp.array[int]
    efc_address: wp.array2d[int]
    count: wp.array[int]
    listed: wp.array2d[int]
    soft: wp.array[wp.vec3]


@wp.func
def enlist(p: Listing, i: int, world: int):
    """Give a contact its rows, its world's list the contact, and say how soft it is: stiffness D of a
    row, its part of -aref from the depth, and damping, all as in MuJoCo."""
    constrains = (p.type[i] & wp.static(int(types.ContactType.CONSTRAINT))) != 0
    off = (p.disableflags & wp.static(int(types.DisableBit.CONTACT | types.DisableBit.CONSTRAINT))) != 0
    depth = p.dist[i] - p.includemargin[i]
    if off or not constrains or depth >= 0.0:
        return
    rows = wp.max(1, 2 * (p.dim[i] - 1))
    first = wp.atomic_add(p.nefc, world, rows)
    fits = first + rows <= p.room
    if fits:
        p.listed[world, wp.atomic_add(p.count, world, 1)] = i
    for r in range(rows):
        p.efc_address[i, r] = wp.where(fits, first + r, -1)
    kbi = constraint._contact_kbimp(
        p.disableflags, p.timestep[0], p.solref[i], p.solimp[i], depth, False
    )
    of = world % p.body_invweight0.shape[0]
    weight = 0.0
    for k in range(2):
        weight += p.body_invweight0[of, p.geom_bodyid[p.geom[i][k]]][0]
    if p.dim[i] > 1:
        ratio = p.friction[i][0] * p.friction[i][0]
        weight = (weight + ratio * weight) * 2.0 * ratio * p.impratio_invsqrt[0] * p.impratio_invsqrt[0]
    p.soft[i] = wp.vec3(constraint._efc_D(weight, kbi[2]), kbi[0] * kbi[2] * depth, kbi[1])


@wp.kernel(enable_backward=False)
def assign(p: Listing, nacon: wp.array[int]):
    """`enlist` the contacts of all worlds."""
    i = wp.tid()
    if i < nacon[0]:
        enlist(p, i, p.worldid[i])


@wp.struct
class Problem:
    iterations: int
    ls_iterations: int
    tolerance: wp.array[float]
    ls_tolerance: wp.array[float]
    full: int  # the flag of a solve that is cut short
    begin: wp.array[int]  # where each row of M begins in `column` and `place`
    column: wp.array[int]
    place: wp.array[int]  # in M
    body_rootid: wp.array[int]
    body_isdofancestor: wp.array2d[int]
    dof_bodyid: wp.array[int]
    geom_bodyid: wp.array[int]
    M: wp.array2d[float]
    qvel: wp.array2d[float]
    qacc_warmstart: wp.array2d[float]
    qfrc_smooth: wp.array2d[float]
    subtree_com: wp.array2d[wp.vec3]
    cdof: wp.array2d[wp.spatial_vector]
    ne: wp.array[int]
    nf: wp.array[int]
    nl: wp.array[int]
    room: int  # for rows
    J: wp.array3d[float]
    aref: wp.array2d[float]
    D: wp.array2d[float]
    loss: wp.array2d[float]
    residual: wp.array2d[float]  # of plain rows, J x - aref
    slope: wp.array2d[float]  # J d
    curvature: wp.array2d[float]
    count: wp.array[int]  # of contacts
    listed: wp.array2d[int]
    soft: wp.array[wp.vec3]
    geom: wp.array[wp.vec2i]
    dim: wp.array[int]
    pos: wp.array[wp.vec3]
    frame: wp.array[wp.mat33]
    friction: wp.array[vec5]
    address: wp.array2d[int]
    scratch: wp.array2d[float]
    qacc: wp.array2d[float]
    Ma: wp.array2d[float]
    force: wp.array2d[float]
    qfrc_constraint: wp.array2d[float]
    niter: wp.array[int]
    overflow: wp.array[int]


def threads(d: Any) -> int:
    """Of a block: a warp, and on a CPU one, unless tests ask for as many."""
    return THREADS if d.qacc.device.is_cuda or wp.config.enable_cpu_blocks else 1


def scratch_size(nv: int, room: int) -> int:
    """Floats of a world in `scratch`, which newton.cu divides up and holds to this."""
    width = -(-nv // 4) * 4
    of_contact, of_pair = 36, 6 * width + 36
    return room * (of_contact + of_pair) + (nv + 1) * width


def shape_of(nv: int, d: Any) -> tuple[int, int]:
    """Threads of a world, and worlds of a block."""
    lanes = threads(d)
    if d.nworld > MANY and nv <= HALF:
        lanes = min(lanes, HALF)
    # on a CPU all threads of a block wait for each other
    return lanes, THREADS // lanes if d.qacc.device.is_cuda else 1


@functools.cache
def newton_function(nv: int, room: int, lanes: int, worlds: int) -> Any:
    sizes = f"NV = {nv}, ROOM = {room}, LANES = {lanes}, WORLDS = {worlds}"

    @wp.func_native(f"constexpr int {sizes}, SCRATCH = {scratch_size(nv, room)};\n{SOURCE}")
    def newton(p: Problem, world: int, thread: int): ...

    return newton


@functools.cache
def newton_kernel(nv: int, room: int, lanes: int, worlds: int) -> Any:
    newton = newton_function(nv, room, lanes, worlds)

    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=REGISTERS)
    def kernel(p: Problem):
        block, thread = wp.tid()
        world = block * worlds + thread // lanes
        if world < p.qacc.shape[0]:
            newton(p, world, thread)

    return kernel


@dataclasses.dataclass
class Workspace:
    """Of the worlds of one `Data`."""

    count: wp.array  # [worlds] contacts
    listed: wp.array  # [worlds, room] their indices
    soft: wp.array  # [contacts, 3], of `assign`
    by_row: list[wp.array]  # each [worlds, rows]
    scratch: wp.array
    never: int  # flags of contacts, which are not plain rows, and of what the model has none of


def uncovered(m: Any, d: Any) -> list[str]:
    """What the kernel is not for in a model with the options that `m` has now, in a few words each."""
    opt, off = m.opt, mujoco_warp.DisableBit
    batched = (opt.tolerance, opt.ls_tolerance, opt.timestep, opt.impratio_invsqrt)
    found = {
        f"{m.nv} degrees of freedom": not 0 < m.nv <= MOST or m.is_sparse,
        "no room for constraints": d.njmax <= 0,
        "flexible bodies": m.nflex > 0,
        "adhesion": m.flg_adhesion or m.actuator_trntype_body_adr.size > 0,
        "surfaces that move": m.flg_surfacevel,
        "a solver other than Newton's": opt.solver != mujoco_warp.SolverType.NEWTON,
        "elliptic friction cones": opt.cone != mujoco_warp.ConeType.PYRAMIDAL,
        "a discrete integrator": opt.integrator == mujoco_warp.IntegratorType.DISCRETE,
        "noslip iterations": opt.noslip_iterations != 0,
        "no warmstart": opt.disableflags & off.WARMSTART,
        "sleeping bodies": opt.enableflags & mujoco_warp.EnableBit.SLEEP,
        "options that differ between worlds": any(x.shape[0] != 1 for x in batched),
    }
    return [name for name, is_so in found.items() if is_so]


def adopt(model: mujoco.MjModel, m: Any, d: Any) -> bool:
    """Have the worlds of `d` solved here, unless something is `uncovered`; then MuJoCo Warp does it.

    It looks at the options of `m` as they are now. MuJoCo Warp's inverse dynamics and adhesion, which
    read the rows of contacts, are not for data that was adopted. A contact whose rows do not all fit
    into `njmax` is left out, and the world flagged as MuJoCo Warp does.

    Args:
        model: what `m` and `d` were made of.
    """
    worlds = d.nworld
    if uncovered(m, d):
        return False
    dim = min([*model.geom_condim, *model.pair_dim], default=1)
    fewest = max(1, 2 * (dim - 1))  # rows of a contact
    room = -(-d.njmax // fewest // 32) * 32  # few kernels for many scenes
    off = mujoco_warp.DisableBit
    some = {
        off.EQUALITY: model.neq,
        off.FRICTIONLOSS: m.dof_frictionloss.numpy().any() or model.ntendon,
        off.LIMIT: model.jnt_limited.any() or model.ntendon,
    }
    d.newton = Workspace(
        count=wp.zeros(worlds, dtype=int),
        listed=wp.zeros((worlds, room), dtype=int),
        soft=wp.zeros(d.naconmax, dtype=wp.vec3),
        by_row=[wp.zeros((worlds, d.njmax), dtype=float) for _ in range(3)],
        scratch=wp.zeros((worlds, scratch_size(m.nv, room)), dtype=float),
        never=int(off.CONTACT) | sum(int(flag) for flag, present in some.items() if not present),
    )
    return True


def make_constraint(m: Any, d: Any) -> None:
    """In place of MuJoCo Warp's: plain rows as it has them, and the lists of contacts."""
    work = getattr(d, "newton", None)
    if work is None:
        their_constraints(m, d)
        return
    plain_rows(m, d)
    work.count.zero_()
    list_contacts(m, d)


def plain_rows(m: Any, d: Any) -> None:
    opt = dataclasses.replace(m.opt, disableflags=m.opt.disableflags | d.newton.never)
    their_constraints(dataclasses.replace(m, opt=opt), d)


def list_contacts(m: Any, d: Any) -> None:
    """After the plain rows, to lists that are empty."""
    wp.launch(assign, d.naconmax, inputs=[listing(m, d), d.nacon])


def listing(m: Any, d: Any) -> Any:
    """For `enlist`: the options of `m` as they are now, and the arrays of `d`, which was adopted."""
    p = Listing()
    for name in Listing.vars:
        for owner in (m, m.opt, d, d.contact, d.newton):
            if hasattr(owner, name):
                setattr(p, name, getattr(owner, name))
    p.room = d.njmax
    return p


def solve(m: Any, d: Any) -> None:
    """In place of MuJoCo Warp's `solver.solve`."""
    work = getattr(d, "newton", None)
    if work is None:
        theirs(m, d)
        return
    lanes, worlds = shape_of(m.nv, d)
    kernel = newton_kernel(m.nv, work.listed.shape[1], lanes, worlds)
    blocks = -(-d.nworld // worlds)
    wp.launch_tiled(kernel, dim=blocks, inputs=[problem(m, d)], block_dim=lanes * worlds)


def problem(m: Any, d: Any) -> Any:
    """What is solved: the options of `m` as they are now, and the arrays of `d`, which was adopted."""
    work = d.newton
    efc, contact = d.efc, d.contact
    p = Problem()
    p.iterations, p.ls_iterations = m.opt.iterations, m.opt.ls_iterations
    p.tolerance, p.ls_tolerance = m.opt.tolerance, m.opt.ls_tolerance
    p.full = int(mujoco_warp.OverflowType.ITERATIONS)
    p.begin, p.column, p.place = m.M_mulm_rowadr, m.M_mulm_col, m.M_mulm_madr
    for name in ("body_rootid", "body_isdofancestor", "dof_bodyid", "geom_bodyid"):
        setattr(p, name, getattr(m, name))
    for name in ("M", "qvel", "qacc_warmstart", "qfrc_smooth", "subtree_com", "cdof"):
        setattr(p, name, getattr(d, name))
    p.ne, p.nf, p.nl = d.ne, d.nf, d.nl
    p.room, p.J, p.aref, p.D, p.loss = d.njmax, efc.J, efc.aref, efc.D, efc.frictionloss
    p.residual, p.slope, p.curvature = work.by_row
    p.count, p.listed, p.soft, p.scratch = work.count, work.listed, work.soft, work.scratch
    for name in ("geom", "dim", "pos", "frame", "friction"):
        setattr(p, name, getattr(contact, name))
    p.address = contact.efc_address
    p.qacc, p.Ma, p.force, p.qfrc_constraint = d.qacc, efc.Ma, efc.force, d.qfrc_constraint
    p.niter, p.overflow = d.solver_niter, d.overflow
    return p
