"""What constrains a world: where geoms touch, and which joints are at their limits, in one kernel.

A thread looks at one pair of geoms, or one joint, of one world. Where the pair is near and has a
formula, it writes the contacts. The formulas are MuJoCo Warp's, and ours for boxes with pillars. Near
pairs of convex shapes that have none are listed for MuJoCo Warp's kernels. MuJoCo Warp itself lists all
near pairs in one kernel, looks at them in another, and takes three more for limits.
"""
# Kernels are Warp's language in Python's syntax, which no type checker of Python knows:
# pyright: reportIndexIssue=false, reportAssignmentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportInvalidTypeForm=false

import collections
import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import warp as wp
from mujoco.mjx.third_party import mujoco_warp
from mujoco.mjx.third_party.mujoco_warp._src import (
    collision_convex,
    collision_core,
    collision_driver,
    collision_primitive,
    constraint,
)
from mujoco.mjx.third_party.mujoco_warp._src.collision_core import (
    contact_margin_gap,
    contact_material_params,
    write_contact,
)
from mujoco.mjx.third_party.mujoco_warp._src.math import make_frame

from jaxsafe.envs.engines.warp.pillars import touch, upright_pairs
from jaxsafe.envs.engines.warp.recording import Recording
from jaxsafe.envs.engines.warp.solver import REGISTERS
from jaxsafe.envs.engines.warp.touching import FORMULAS, NONE, PILLAR, Touch

GeomType = mujoco_warp.GeomType
vec5 = wp.types.vector(length=5, dtype=float)
MESH = (GeomType.PLANE, GeomType.MESH)  # has a formula, but it needs the mesh


@wp.struct
class Geoms:
    """The pairs, and the model's fields that say where geoms are and what they are made of."""

    pairs: wp.array[wp.vec2i]
    pairids: wp.array[wp.vec2i]  # which <pair> and which collision sensor each is of
    kinds: wp.array[int]  # the place of their formula in FORMULAS, PILLAR or NONE
    geom_size: wp.array2d[wp.vec3]
    geom_condim: wp.array[int]
    geom_priority: wp.array[int]
    geom_solmix: wp.array2d[float]
    geom_solref: wp.array2d[wp.vec2]
    geom_solimp: wp.array2d[vec5]
    geom_friction: wp.array2d[wp.vec3]
    geom_margin: wp.array2d[float]
    geom_gap: wp.array2d[float]
    geom_adhesion: wp.array2d[float]
    geom_aabb: wp.array3d[wp.vec3]
    geom_rbound: wp.array2d[float]
    pair_dim: wp.array[int]
    pair_solref: wp.array2d[wp.vec2]
    pair_solreffriction: wp.array2d[wp.vec2]
    pair_solimp: wp.array2d[vec5]
    pair_margin: wp.array2d[float]
    pair_gap: wp.array2d[float]
    pair_adhesion: wp.array2d[float]
    pair_friction: wp.array2d[vec5]
    geom_xpos: wp.array2d[wp.vec3]
    geom_xmat: wp.array2d[wp.mat33]


@wp.struct
class Found:
    """The lists of all worlds, contacts and near pairs without a formula, and how long each may be."""

    dist: wp.array[float]
    pos: wp.array[wp.vec3]
    frame: wp.array[wp.mat33]
    includemargin: wp.array[float]
    friction: wp.array[vec5]
    solref: wp.array[wp.vec2]
    solreffriction: wp.array[wp.vec2]
    solimp: wp.array[vec5]
    dim: wp.array[int]
    geom: wp.array[wp.vec2i]
    efc_address: wp.array2d[int]
    worldid: wp.array[int]
    type: wp.array[int]
    geomcollisionid: wp.array[int]
    adhesion: wp.array[float]
    count: wp.array[int]
    near_pair: wp.array[wp.vec2i]
    near_pairid: wp.array[wp.vec2i]
    near_world: wp.array[int]
    near_count: wp.array[int]
    room: int


@wp.struct
class Lists:
    """Of each world its own list of contacts, [worlds, room]; `count` is [worlds, 1]."""

    dist: wp.array2d[float]
    pos: wp.array2d[wp.vec3]
    frame: wp.array2d[wp.mat33]
    includemargin: wp.array2d[float]
    friction: wp.array2d[vec5]
    solref: wp.array2d[wp.vec2]
    solreffriction: wp.array2d[wp.vec2]
    solimp: wp.array2d[vec5]
    dim: wp.array2d[int]
    geom: wp.array2d[wp.vec2i]
    efc_address: wp.array3d[int]
    worldid: wp.array2d[int]
    type: wp.array2d[int]
    geomcollisionid: wp.array2d[int]
    adhesion: wp.array2d[float]
    count: wp.array2d[int]


@wp.func
def own(lists: Lists, world: int) -> Found:
    """The list of one world."""
    mine = Found()
    mine.dist = lists.dist[world]
    mine.pos = lists.pos[world]
    mine.frame = lists.frame[world]
    mine.includemargin = lists.includemargin[world]
    mine.friction = lists.friction[world]
    mine.solref = lists.solref[world]
    mine.solreffriction = lists.solreffriction[world]
    mine.solimp = lists.solimp[world]
    mine.dim = lists.dim[world]
    mine.geom = lists.geom[world]
    mine.efc_address = lists.efc_address[world]
    mine.worldid = lists.worldid[world]
    mine.type = lists.type[world]
    mine.geomcollisionid = lists.geomcollisionid[world]
    mine.adhesion = lists.adhesion[world]
    mine.count = lists.count[world]
    mine.room = lists.dist.shape[1]
    return mine


@wp.struct
class Joints:
    """The joints with a limit, and the rows of the worlds' constraints."""

    limited: wp.array[int]
    jnt_qposadr: wp.array[int]
    jnt_dofadr: wp.array[int]
    jnt_range: wp.array2d[wp.vec2]
    jnt_margin: wp.array2d[float]
    jnt_solref: wp.array2d[wp.vec2]
    jnt_solimp: wp.array2d[vec5]
    dof_invweight0: wp.array2d[float]
    timestep: wp.array[float]
    disableflags: int
    qpos: wp.array2d[float]
    qvel: wp.array2d[float]
    nl: wp.array[int]
    nefc: wp.array[int]
    J: wp.array3d[float]
    D: wp.array2d[float]
    aref: wp.array2d[float]
    room: int  # for rows


@wp.func
def limit(p: Joints, world: int, joint: int):
    """The row of a hinge or slide that is beyond its limit, as MuJoCo has it."""
    at, ends = p.qpos[world, p.jnt_qposadr[joint]], p.jnt_range[0, joint]
    sign = wp.where(at - ends[0] < ends[1] - at, 1.0, -1.0)
    left = wp.min(at - ends[0], ends[1] - at) - p.jnt_margin[0, joint]
    if left >= 0.0:
        return
    wp.atomic_add(p.nl, world, 1)
    row = wp.atomic_add(p.nefc, world, 1)
    if row >= p.room:
        return
    dof = p.jnt_dofadr[joint]
    for i in range(p.qvel.shape[1]):
        p.J[world, row, i] = wp.where(i == dof, sign, 0.0)
    kbi = constraint._contact_kbimp(
        p.disableflags, p.timestep[0], p.jnt_solref[0, joint], p.jnt_solimp[0, joint], left, False
    )
    p.D[world, row] = constraint._efc_D(p.dof_invweight0[0, dof], kbi[2])
    p.aref[world, row] = -kbi[0] * kbi[2] * left - kbi[1] * sign * p.qvel[world, dof]


@wp.func
def geom_at(m: Geoms, world: int, geom: int) -> collision_core.Geom:
    found = collision_core.Geom()
    found.pos = m.geom_xpos[world, geom]
    found.rot = m.geom_xmat[world, geom]
    found.size = m.geom_size[world % m.geom_size.shape[0], geom]
    found.normal = wp.vec3(found.rot[0, 2], found.rot[1, 2], found.rot[2, 2])
    return found


@wp.func
def pillar_box(pillar: collision_core.Geom, box: collision_core.Geom) -> Touch:
    """See pillars.py."""
    found = Touch()
    far = pillar.size[0] + wp.length(box.size)
    away = wp.vec2(pillar.pos[0] - box.pos[0], pillar.pos[1] - box.pos[1])
    if wp.length_sq(away) > far * far:
        return found
    tall = pillar.size[1] + wp.dot(wp.abs(box.rot[2]), box.size)
    if wp.abs(pillar.pos[2] - box.pos[2]) > tall:
        return found
    dists, heights, n, flat = touch(pillar.pos, pillar.size[0], box.pos, box.rot, box.size)
    deepest = wp.where(dists[0] < dists[1], 0, 1)
    if dists[deepest] >= 0.0:
        return found
    found.count = wp.where(flat, 2, 1)
    for k in range(2):
        end = wp.where(dists[k] < 0.0, k, deepest)  # of a side that leans MuJoCo has one end twice
        back = pillar.size[0] + 0.5 * dists[end]
        found.dist[k] = dists[end]
        found.pos[k] = wp.vec3(pillar.pos[0] - back * n[0], pillar.pos[1] - back * n[1], heights[end])
    found.frame = make_frame(-n)
    found.frame_of_others = found.frame
    return found


@functools.cache
def constraint_function(kinds: tuple[int, ...], near_by: tuple[int, ...]) -> Any:
    """What looks at a pair of geoms, or a joint.

    Args:
        kinds: places in FORMULAS, and PILLAR where there are some.
        near_by: what MuJoCo Warp's test of nearness is made for.
    """
    formulas, known = list(FORMULAS.values()), sum(1 << kind for kind in kinds)
    given = [kind for kind in kinds if kind != PILLAR]
    near = collision_driver._broadphase_filter(*near_by)

    @wp.func
    def touch_of(
        kind: int, one: collision_core.Geom, other: collision_core.Geom, margin: float, gap: float
    ) -> Touch:
        if wp.static(PILLAR in kinds):  # noqa: SIM102, or it would be compiled for all
            if kind == PILLAR:
                return pillar_box(one, other)
        for k in range(wp.static(len(given))):
            if kind == wp.static(given[k]):
                return wp.static(formulas[given[k]])(one, other, margin, gap)
        return Touch()

    @wp.func
    def look(i: int, world: int, m: Geoms, joints: Joints, out: Found):
        if i >= m.pairs.shape[0]:
            limit(joints, world, joints.limited[i - m.pairs.shape[0]])
            return
        pair, ids, kind = m.pairs[i], m.pairids[i], m.kinds[i]
        if kind != PILLAR and ids[1] < 0 and not near(
            m.geom_aabb, m.geom_rbound, m.geom_margin, m.geom_gap, m.pair_margin, m.pair_gap,
            m.geom_xpos, m.geom_xmat, pair[0], pair[1], ids[0], world,
        ):  # fmt: skip
            return
        if (known >> kind) & 1 == 0:  # also tells Warp apart what it compiles for other kinds
            place = wp.atomic_add(out.near_count, 0, 1)
            if place < out.room:
                out.near_pair[place] = pair
                out.near_pairid[place] = ids
                out.near_world[place] = world
            return
        margin, gap = contact_margin_gap(
            m.geom_margin, m.geom_gap, m.pair_margin, m.pair_gap, pair, ids[0], world
        )
        one, other = geom_at(m, world, pair[0]), geom_at(m, world, pair[1])
        found = touch_of(kind, one, other, margin, gap)
        if found.count == 0:
            return
        condim, friction, solref, solreffriction, solimp, adhesion = contact_material_params(
            m.geom_condim, m.geom_priority, m.geom_solmix, m.geom_solref, m.geom_solimp,
            m.geom_friction, m.geom_adhesion, m.pair_dim, m.pair_solref, m.pair_solreffriction,
            m.pair_solimp, m.pair_adhesion, m.pair_friction, pair, ids[0], world,
        )  # fmt: skip
        for k in range(found.count):
            frame = found.frame
            if k > 0:
                frame = found.frame_of_others
            write_contact(
                out.room, k, found.dist[k], found.pos[k], frame, margin, gap, condim, friction, solref,
                solreffriction, solimp, adhesion, pair, ids, world, out.dist, out.pos, out.frame,
                out.includemargin, out.friction, out.solref, out.solreffriction, out.solimp, out.dim,
                out.geom, out.efc_address, out.worldid, out.type, out.geomcollisionid, out.adhesion,
                out.count,
            )  # fmt: skip

    return look


@functools.cache
def constraints_kernel(look: Any) -> Any:
    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=REGISTERS)
    def kernel(m: Geoms, joints: Joints, out: Found):
        i, world = wp.tid()
        look(i, world, m, joints, out)

    return kernel


@dataclasses.dataclass
class Constraints:
    """Of the worlds of one `Data`."""

    look: Any  # a function of one pair or joint
    geoms: Any
    joints: Any
    found: Any
    others: Recording  # MuJoCo Warp's kernels for the near pairs without a formula

    @property
    def looks(self) -> int:
        """How many pairs and joints a world has."""
        return len(self.geoms.pairs) + len(self.joints.limited)

    @property
    def by_formula(self) -> bool:
        """Whether no pair needs MuJoCo Warp's kernels."""
        return not self.others.launches

    def by_world(self, worlds: int) -> Any:
        """The lists of contacts, a part of them for each world."""
        lists = Lists()
        for name in Lists.vars.keys() - {"count"}:
            x = getattr(self.found, name)
            setattr(lists, name, x.reshape((worlds, -1, *x.shape[1:])))
        lists.count = wp.zeros((worlds, 1), dtype=int, device=self.found.dist.device)
        return lists

    def find(self, worlds: int) -> None:
        """All contacts, and the rows of limits. What counts them has to be 0 before."""
        wp.launch(
            constraints_kernel(self.look),
            (self.looks, worlds),
            inputs=[self.geoms, self.joints],
            outputs=[self.found],
        )
        self.others.repeat()


def adopt(
    model: mujoco.MjModel, m: Any, d: Any, upright: Sequence[str], limits: bool
) -> Constraints | None:
    """What finds the constraints of `d`; None: MuJoCo Warp has to, since there are many geoms, or some
    that differ between worlds or are given by a distance.

    Args:
        model: what `m` and `d` were made of.
        upright: the names of the bodies of pillars.
        limits: whether to find those of joints.
    """
    nxn = m.opt.broadphase == mujoco_warp.BroadphaseType.NXN
    if not nxn or m.has_sdf_geom or m.geom_dataid.shape[0] > 1 or m.callback.contactfilter:
        return None
    pairs, ids = m.nxn_geom_pair_filtered.numpy(), m.nxn_pairid_filtered.numpy()
    kind = model.geom_type
    pairs = np.where((kind[pairs[:, 0]] > kind[pairs[:, 1]])[:, None], pairs[:, ::-1], pairs)
    kinds = [(GeomType(kind[a]), GeomType(kind[b])) for a, b in pairs]
    place = {of: k for k, of in enumerate(FORMULAS)}
    places = np.array([place.get(of, NONE) for of in kinds], int)
    if mujoco_warp.GeomType.HFIELD not in kind:  # a pair of others is one convex collision at most
        convex = collections.Counter(of for of in kinds if of not in FORMULAS)
        d.naccdmax = min(d.naccdmax, d.nworld * max(convex.values(), default=0))
    # neither a pair with settings of its own nor a sensor's
    pillars = upright_pairs(model, pairs, upright) & (ids == -1).all(1)
    others = (places == NONE) & ~pillars
    places = np.where(pillars, PILLAR, places)
    has = {pair for pair, without in zip(kinds, others, strict=True) if without}

    geoms, joints, found, device = Geoms(), Joints(), Found(), d.qacc.device
    for struct, names, owners in (
        (geoms, Geoms.vars, (m, d)),
        (joints, Joints.vars, (m, m.opt, d, d.efc)),
        (found, Found.vars, (d.contact,)),
    ):
        for name in names:
            for owner in owners:
                if hasattr(owner, name):
                    setattr(struct, name, getattr(owner, name))
    joints.limited = m.jnt_limited_slide_hinge_adr if limits else wp.empty(0, dtype=int, device=device)
    joints.room = d.njmax
    geoms.pairs = wp.array(pairs, dtype=wp.vec2i, device=device)
    geoms.pairids = wp.array(ids, dtype=wp.vec2i, device=device)
    near = collision_core.create_collision_context(d.naconmax)
    found.count, found.room, found.near_count = d.nacon, d.naconmax, d.ncollision
    found.near_pair, found.near_pairid = near.collision_pair, near.collision_pairid
    found.near_world = near.collision_worldid
    near_by = (m.geom_aabb, m.geom_rbound, m.geom_margin, m.geom_gap, m.pair_margin, m.pair_gap)
    geoms.kinds = wp.array(places, dtype=int, device=device)
    look = constraint_function(
        tuple(sorted(set(places.tolist()) - {NONE})),
        (int(m.opt.broadphase_filter), *(x.shape[0] for x in near_by)),
    )

    def narrow() -> None:
        collision_convex.convex_narrowphase(m, d, near, sorted(has - {MESH}))
        if MESH in has:
            collision_primitive.primitive_narrowphase(m, d, near, [MESH])

    return Constraints(look, geoms, joints, found, Recording(narrow))
