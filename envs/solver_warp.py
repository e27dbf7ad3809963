"""MuJoCo's Newton solver for engine `warp`, with all iterations of a world in one kernel.

    minimise_x  (x - x0)' M (x - x0) / 2 + sum_r s_r(J_r x - aref_r)

x: accelerations, x0: those without constraints, s_r: the cost of row r, convex and quadratic in pieces.
An iteration solves H d = -g with the gradient g and the Hessian H = M + J' diag(s'') J, and goes along
d to where the slope vanishes. It ends where g' H^-1 g, what the next one would gain, is small.

Source: Todorov (2014), "Convex and analytically-invertible dynamics with contacts and constraints", and
MuJoCo's documentation, Computation. MuJoCo Warp launches ten kernels an iteration for all worlds, until
the last one has converged; here a block of threads stays with one world until that has. A thread has a
degree of freedom and every 32nd row; on Warp's CPU device one thread has them all.
It does not write `efc.state`, and sets the flag of a solve that is cut short without printing it.

Models that the kernel is not for (`ours`) get MuJoCo Warp's own.
"""
# Kernels are Warp's language in Python's syntax, which no type checker of Python knows:
# pyright: reportIndexIssue=false, reportAssignmentType=false, reportGeneralTypeIssues=false
# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportReturnType=false, reportInvalidTypeForm=false

import functools
from typing import Any

import warp as wp
from mujoco.mjx.third_party.mujoco_warp._src import solver, types

THREADS = 32  # of a block: a warp
REGISTERS = 168  # of a thread, for 12 blocks a multiprocessor
CHUNK = wp.constant(32)  # rows of J in shared memory
# Degrees of freedom. With the 31 of doggo_goal2 MuJoCo Warp's solver is faster; beyond 32 J is sparse.
MOST = 24
ROUNDING = 8 * 1.1920929e-07  # of a sum of float32, relative to its largest terms

theirs = solver.solve


@wp.func_native("WP_TILE_SYNC();")
def sync(): ...


def eliminate(n: int) -> str:
    """C++ that solves H d = -g; H is positive definite and needs no pivots.

    Each thread of the block, which is one warp, has a row.
    """
    return f"""
#if defined(__CUDA_ARCH__)
    const unsigned all = 0xffffffff;
    const int row = threadIdx.x;
    if (row < 32) {{
        const int own = min(row, {n - 1});
        float a[{n}], pivot[{n}];  // the pivots' inverses
        float b = -wp::load(wp::address(g, own)), x = 0.0f;
        #pragma unroll
        for (int j = 0; j < {n}; ++j) a[j] = wp::load(wp::address(H, j, own));
        #pragma unroll
        for (int k = 0; k < {n}; ++k) {{
            pivot[k] = __frcp_rn(__shfl_sync(all, a[k], k));
            const float factor = row > k ? a[k] * pivot[k] : 0.0f;
            #pragma unroll
            for (int j = k + 1; j < {n}; ++j) a[j] -= factor * __shfl_sync(all, a[j], k);
            b -= factor * __shfl_sync(all, b, k);
        }}
        #pragma unroll
        for (int k = {n} - 1; k >= 0; --k) {{
            const float last = __shfl_sync(all, b, k) * pivot[k];
            if (row == k) x = last;
            if (row < k) b -= a[k] * last;
        }}
        if (row < {n}) wp::store(wp::address(d, row), x);
    }}
#else
    float a[{n}][{n}], b[{n}];
    for (int i = 0; i < {n}; ++i) {{
        b[i] = -wp::load(wp::address(g, i));
        for (int j = 0; j < {n}; ++j) a[i][j] = wp::load(wp::address(H, i, j));
    }}
    for (int k = 0; k < {n}; ++k)
        for (int i = k + 1; i < {n}; ++i) {{
            const float factor = a[i][k] / a[k][k];
            for (int j = k + 1; j < {n}; ++j) a[i][j] -= factor * a[k][j];
            b[i] -= factor * b[k];
        }}
    for (int k = {n} - 1; k >= 0; --k) {{
        for (int j = k + 1; j < {n}; ++j) b[k] -= a[k][j] * b[j];
        b[k] /= a[k][k];
        wp::store(wp::address(d, k), b[k]);
    }}
#endif
    """


@wp.func
def pull(row: int, ne: int, nf: int, x: float, stiffness: float, loss: float) -> wp.vec2:
    """Force -s'(x) and curvature s''(x) of a row: equalities come first, then dry friction, then what
    only pushes."""
    linear = False
    if row >= ne + nf:
        if x >= 0.0:
            return wp.vec2(0.0, 0.0)
    elif row >= ne:
        linear = wp.abs(x) * stiffness >= loss
    if linear:
        return wp.vec2(-wp.sign(x) * loss, 0.0)
    return wp.vec2(-stiffness * x, stiffness)


@wp.func
def pick(a: wp.vec4, part: int) -> float:
    return wp.where(part < 2, wp.where(part == 0, a[0], a[1]), wp.where(part == 2, a[2], a[3]))


@functools.cache
def newton_kernel(nv: int) -> Any:
    quads = -(-nv // 4)  # of a row of J, whose columns beyond nv are 0
    Vector = wp.types.vector(length=4 * quads, dtype=float)

    @wp.func_native(eliminate(nv))
    def solve_together(H: wp.array2d[float], g: wp.array[float], d: wp.array[float]): ...

    @wp.func
    def read(row: wp.array[float]) -> Vector:
        v = Vector()
        for i in range(wp.static(nv)):
            v[i] = row[i]
        return v

    @wp.func
    def dot(row: wp.array[wp.vec4], v: Vector) -> float:
        total = float(0.0)
        for q in range(wp.static(quads)):
            a = row[q]
            total += a[0] * v[4 * q] + a[1] * v[4 * q + 1] + a[2] * v[4 * q + 2] + a[3] * v[4 * q + 3]
        return total

    @wp.func
    def product(
        i: int,
        begin: wp.array[int],
        column: wp.array[int],
        place: wp.array[int],
        M: wp.array[float],
        v: wp.array[float],
    ) -> float:
        """(M v)_i."""
        total = float(0.0)
        for k in range(begin[i], begin[i + 1]):
            total += M[place[k]] * v[column[k]]
        return total

    @wp.kernel(
        module="unique",
        enable_backward=False,
        cuda_max_registers=REGISTERS,
        module_options={"max_unroll": MOST},
    )
    def newton(
        iterations: int,
        ls_iterations: int,
        tolerances: wp.array[float],
        ls_tolerances: wp.array[float],
        begin: wp.array[int],  # where each row of M begins in `column` and `place`
        column: wp.array[int],
        place: wp.array[int],  # in M
        M: wp.array2d[float],
        qacc_warmstart: wp.array2d[float],
        qacc_smooth: wp.array2d[float],
        qfrc_smooth: wp.array2d[float],
        ne: wp.array[int],
        nf: wp.array[int],
        nefc: wp.array[int],
        room: int,  # for rows
        J: wp.array3d[wp.vec4],  # four columns at a time
        aref: wp.array2d[float],
        stiffness: wp.array2d[float],
        loss: wp.array2d[float],
        residual: wp.array2d[float],  # J x - aref
        slope: wp.array2d[float],  # J d
        curvature: wp.array2d[float],
        change: wp.array2d[float],  # of the curvature, since H was made
        H: wp.array3d[float],
        g: wp.array2d[float],
        d: wp.array2d[float],
        Md: wp.array2d[float],
        x: wp.array2d[float],
        Mx: wp.array2d[float],
        force: wp.array2d[float],
        qfrc_constraint: wp.array2d[float],
        niter: wp.array[int],
        overflow: wp.array[int],
    ):
        world, thread = wp.tid()
        threads = wp.block_dim()
        rows = wp.min(nefc[world], room)
        equal, dry = ne[world], nf[world]

        trace = float(0.0)
        for i in range(thread, nv, threads):
            x[world, i] = wp.where(rows > 0, qacc_warmstart[world, i], qacc_smooth[world, i])
            for j in range(nv):
                H[world, i, j] = 0.0
            for k in range(begin[i], begin[i + 1]):
                H[world, i, column[k]] = M[world, place[k]]
            trace += H[world, i, i]
        scale = 1.0 / wp.max(types.MJ_MINVAL, wp.tile_reduce(wp.add, wp.tile(trace))[0])
        tolerance = tolerances[0]
        sync()
        for i in range(thread, nv, threads):
            Mx[world, i] = product(i, begin, column, place, M[world], x[world])
            g[world, i] = Mx[world, i] - qfrc_smooth[world, i]
        start = read(x[world])
        for row in range(thread, rows, threads):
            residual[world, row] = dot(J[world, row], start) - aref[world, row]
            slope[world, row] = 0.0
            curvature[world, row] = 0.0

        steps = int(0)
        done = bool(rows == 0)
        alpha = float(0.0)
        decrement = float(0.0)  # g' H^-1 g
        while not done:
            # where the last step has led
            changes = int(dry)  # the two linear pieces of dry friction have the same curvature
            for row in range(thread, rows, threads):
                at = residual[world, row] + alpha * slope[world, row]
                here = pull(row, equal, dry, at, stiffness[world, row], loss[world, row])
                changed = here[1] - curvature[world, row]
                residual[world, row] = at
                force[world, row] = here[0]
                change[world, row] = changed
                curvature[world, row] = here[1]
                if changed != 0.0:
                    changes += 1
            changes = wp.tile_reduce(wp.add, wp.tile(changes))[0]

            left = 1.0 - alpha
            if changes == 0 and scale * 0.5 * decrement * left * left < tolerance and steps > 0:
                for i in range(thread, nv, threads):  # all of the step was quadratic
                    g[world, i] = left * g[world, i]
                done = True
            else:
                own = Vector()
                for row in range(thread, rows, threads):
                    pushes = force[world, row]
                    if pushes != 0.0:
                        for q in range(wp.static(quads)):
                            a = J[world, row, q]
                            own[4 * q] += pushes * a[0]
                            own[4 * q + 1] += pushes * a[1]
                            own[4 * q + 2] += pushes * a[2]
                            own[4 * q + 3] += pushes * a[3]
                pulled = wp.tile_reduce(wp.add, wp.tile(own, preserve_type=True))[0]
                for i in range(wp.static(nv)):
                    if i % threads == thread:
                        g[world, i] = Mx[world, i] - qfrc_smooth[world, i] - pulled[i]
                if changes > 0:
                    for turn in range((nv + threads - 1) / threads):
                        mine = wp.min(turn * threads + thread, nv - 1)
                        quad = mine / 4
                        part = mine % 4
                        h = read(H[world, mine])
                        for first in range(0, rows, CHUNK):
                            end = wp.min(first + CHUNK, rows)
                            busy = int(0)
                            for row in range(first + thread, end, threads):
                                if change[world, row] != 0.0:
                                    busy = 1
                            if wp.tile_reduce(wp.add, wp.tile(busy))[0] > 0:
                                weights = wp.tile_load(
                                    change[world], shape=CHUNK, offset=first, storage="shared"
                                )
                                some = wp.tile_load(
                                    J[world],
                                    shape=(CHUNK, wp.static(quads)),
                                    offset=(first, 0),
                                    storage="shared",
                                )
                                for r in range(end - first):
                                    weight = weights[r]
                                    if weight != 0.0:
                                        weight *= pick(some[r, quad], part)
                                        for q in range(wp.static(quads)):
                                            a = some[r, q]
                                            h[4 * q] += weight * a[0]
                                            h[4 * q + 1] += weight * a[1]
                                            h[4 * q + 2] += weight * a[2]
                                            h[4 * q + 3] += weight * a[3]
                                sync()
                        if turn * threads + thread < nv:
                            for i in range(wp.static(nv)):
                                H[world, mine, i] = h[i]
                sync()
                solve_together(H[world], g[world], d[world])
                sync()
                descent = float(0.0)
                for i in range(thread, nv, threads):
                    descent -= g[world, i] * d[world, i]
                decrement = wp.tile_reduce(wp.add, wp.tile(descent))[0]
                if steps > 0 and not (scale * 0.5 * decrement >= tolerance):  # also NaN
                    done = True
                if not done and steps == iterations:
                    overflow[world] = overflow[world] | wp.static(int(types.OverflowType.ITERATIONS))
                    done = True

            if not done:
                sums = wp.vec3()  # of the smooth cost along d: slope at 0, curvature; and |d|^2
                for i in range(thread, nv, threads):
                    along = d[world, i]
                    Md[world, i] = product(i, begin, column, place, M[world], d[world])
                    sums += wp.vec3(
                        along * (Mx[world, i] - qfrc_smooth[world, i]),
                        along * Md[world, i],
                        along * along,
                    )
                direction = read(d[world])
                for row in range(thread, rows, threads):
                    slope[world, row] = dot(J[world, row], direction)
                smooth = wp.tile_reduce(wp.add, wp.tile(sums, preserve_type=True))[0]
                flat = tolerance * ls_tolerances[0] * wp.sqrt(smooth[2]) / scale

                alpha = float(1.0)
                low = float(0.0)
                high = float(wp.inf)
                for _ in range(ls_iterations):
                    sums = wp.vec3()  # of the rows: slope, curvature, size of what the slope sums
                    for row in range(thread, rows, threads):
                        rate = slope[world, row]
                        at = residual[world, row] + alpha * rate
                        here = pull(row, equal, dry, at, stiffness[world, row], loss[world, row])
                        rise = -here[0] * rate
                        sums += wp.vec3(rise, here[1] * rate * rate, wp.abs(rise))
                    bent = wp.tile_reduce(wp.add, wp.tile(sums, preserve_type=True))[0]
                    rise = smooth[0] + alpha * smooth[1] + bent[0]
                    size = wp.abs(smooth[0]) + alpha * smooth[1] + bent[2]
                    if not (wp.abs(rise) > wp.max(flat, ROUNDING * size)):
                        break
                    if rise < 0.0:
                        low = alpha
                    else:
                        high = alpha
                    other = alpha - rise / (smooth[1] + bent[1])
                    if other == alpha:
                        break
                    if other <= low or other >= high:
                        other = 0.5 * (low + high)
                    alpha = other

                if alpha < ROUNDING:
                    done = True  # downhill is lost in rounding
                else:
                    steps += 1
                    for i in range(thread, nv, threads):
                        x[world, i] += alpha * d[world, i]
                        Mx[world, i] += alpha * Md[world, i]

        for i in range(thread, nv, threads):
            qfrc_constraint[world, i] = Mx[world, i] - qfrc_smooth[world, i] - g[world, i]
        if thread == 0:
            niter[world] = steps

    return newton


def ours(m: Any, d: Any) -> bool:
    """Whether the kernel is for a model: dense, pyramidal cones, no other algorithm of MuJoCo's."""
    opt = m.opt
    return (
        0 < m.nv <= MOST
        and d.njmax > 0
        and not m.is_sparse
        and opt.solver == types.SolverType.NEWTON
        and opt.cone == types.ConeType.PYRAMIDAL
        and opt.integrator != types.IntegratorType.DISCRETE
        and opt.noslip_iterations == 0
        and not opt.disableflags & types.DisableBit.WARMSTART
        and not opt.enableflags & types.EnableBit.SLEEP
        and opt.tolerance.shape[0] == opt.ls_tolerance.shape[0] == 1
    )


def solve(m: Any, d: Any) -> None:
    """In place of MuJoCo Warp's `solver.solve`."""
    if not ours(m, d):
        theirs(m, d)
        return
    efc, worlds = d.efc, d.nworld
    J = wp.array(
        ptr=efc.J.ptr,
        dtype=wp.vec4,
        shape=(*efc.J.shape[:2], efc.J.shape[2] // 4),
        device=efc.J.device,
    )
    by_row = [wp.empty((worlds, d.njmax), dtype=float) for _ in range(4)]
    by_dof = [wp.empty((worlds, m.nv), dtype=float) for _ in range(3)]
    wp.launch_tiled(
        newton_kernel(m.nv),
        dim=worlds,
        inputs=[
            m.opt.iterations,
            m.opt.ls_iterations,
            m.opt.tolerance,
            m.opt.ls_tolerance,
            m.M_mulm_rowadr,
            m.M_mulm_col,
            m.M_mulm_madr,
            d.M,
            d.qacc_warmstart,
            d.qacc_smooth,
            d.qfrc_smooth,
            d.ne,
            d.nf,
            d.nefc,
            d.njmax,
            J,
            efc.aref,
            efc.D,
            efc.frictionloss,
            *by_row,
            wp.empty((worlds, m.nv, m.nv), dtype=float),
            *by_dof,
        ],
        outputs=[d.qacc, efc.Ma, efc.force, d.qfrc_constraint, d.solver_niter, d.overflow],
        block_dim=THREADS,
    )
