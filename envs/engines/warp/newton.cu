// MuJoCo's Newton solver for one world: the body of a function in solver.py, which says what is
// solved and how, after lanes.cu. NV, ROOM (for contacts), LANES, WORLDS and SCRATCH are constants there,
// p, world and thread its arguments. Each lane has a degree of freedom, and every LANESth row and contact.
//
// In C++ because indexing Warp's arrays took most of the instructions: this is five times as fast.

constexpr int CHUNK = 32;  // contacts whose A and force are added up at a time
constexpr int WRENCH = 21, SUMS = 28;  // of a pair: lower triangle of A = C' S C, force, 1 unused

// the numbers of a contact: three axes, its arm from the pair's first contact, ..., its residual a in each
// direction, and the change of that along the step
constexpr int ARM = 9, FRICTION = 12, STIFFNESS = 17, SIDES = 18, OFF = 19, RATE = 25;
// and integers: which rows push, as bits, its pair, its place among all contacts, its bodies, those of the
// contact that was listed there
constexpr int PUSHES = 31, PAIR = 32, PLACE = 33, KEY = 34, UNSORTED = 35, FIELDS = 36;
// those of a pair: E [6][N], sums [SUMS], its twist [6], and the place of its first contact
constexpr int TOTALS = 6 * N, TWIST = TOTALS + SUMS, LEAD = TWIST + 6, PARTS = LEAD + 2;

#if defined(__CUDA_ARCH__)
__shared__ float parts[WORLDS][CHUNK * (SUMS + 1)];
#else
static float parts[WORLDS][CHUNK * (SUMS + 1)];
#endif
float* part = parts[place_in_block];

constexpr float ROUNDING = 8 * 1.1920929e-07f;  // of a sum of float32, relative to its largest terms

struct alignas(16) Quad { float at[4]; };  // floats that are read together
auto dot = [](const float* a, const float* b) {
    float total = 0.0f;
    #pragma unroll
    for (int q = 0; q < N / 4; ++q) {
        const Quad x = ((const Quad*)a)[q], y = ((const Quad*)b)[q];
        total += x.at[0] * y.at[0] + x.at[1] * y.at[1] + x.at[2] * y.at[2] + x.at[3] * y.at[3];
    }
    return total;
};
auto add = [](float* a, float weight, const float* b) {  // a += weight b
    #pragma unroll
    for (int q = 0; q < N / 4; ++q) {
        const Quad x = ((const Quad*)b)[q];
        #pragma unroll
        for (int i = 0; i < 4; ++i) a[4 * q + i] += weight * x.at[i];
    }
};

const int equal = p.ne.data[world], dry = p.nf.data[world];
const int plain = wp::min(equal + dry + p.nl.data[world], p.room);
const int contacts = p.count.data[world];
const float *smooth = row_of(p.qfrc_smooth), *J = row_of(p.J), *aref = row_of(p.aref);
const float *D = row_of(p.D), *loss = row_of(p.loss);
const int wide = p.J.strides[1] / sizeof(float);  // columns of J in memory
float *residual = row_of(p.residual), *slope = row_of(p.slope), *curvature = row_of(p.curvature);
float* force = row_of(p.force);

// what the lanes share
float* M = row_of(p.scratch);  // [NV][N]
float* v = M + NV * N;  // [N], a vector to multiply with
float* touch = v + N;  // [ROOM][FIELDS], the contacts, those of a pair side by side
float* joined = touch + FIELDS * ROOM;  // [ROOM][PARTS], the pairs
static_assert((FIELDS + PARTS) * ROOM + (NV + 1) * N == SCRATCH, "scratch");
auto whole = [&](int c, int field) -> int& { return ((int*)touch)[c * FIELDS + field]; };
auto lead = [&](int q) -> int& { return ((int*)joined)[q * PARTS + LEAD]; };

// contacts in the order of their bodies
auto bodies_of = [&](int i) {
    const auto geoms = p.geom.data[i];
    return wp::vec2i(p.geom_bodyid.data[geoms[0]], p.geom_bodyid.data[geoms[1]]);
};
const int* listed = row_of(p.listed);
#pragma unroll 1
for (int c = lane; c < contacts; c += LANES) {
    const auto bodies = bodies_of(listed[c]);
    whole(c, UNSORTED) = bodies[0] * p.body_rootid.shape[0] + bodies[1];
}
sync();
#pragma unroll 1
for (int c = lane; c < contacts; c += LANES) {
    const int own = whole(c, UNSORTED);
    int before = 0;
    #pragma unroll 1
    for (int e = 0; e < contacts; ++e) {
        const int other = whole(e, UNSORTED);
        before += other < own || (other == own && e < c);
    }
    whole(before, PLACE) = listed[c];
    whole(before, KEY) = own;
}
sync();
int pairs = 0, last = -1;
#pragma unroll 1
for (int c = 0; c < contacts; ++c) {
    const int key = whole(c, KEY);
    const bool first = key != last;
    last = key;
    pairs += first;
    if (c % LANES == lane) whole(c, PAIR) = pairs - 1;
    if (!first) continue;
    const int i = whole(c, PLACE);
    float* E = joined + (pairs - 1) * PARTS;
    if (lane == 0) lead(pairs - 1) = i;
    // what the degrees of freedom do to the pair
    const auto bodies = bodies_of(i);
    const int* moves1 = at_row(p.body_isdofancestor, bodies[0]);
    const int* moves2 = at_row(p.body_isdofancestor, bodies[1]);
    for (int j = lane; j < N; j += LANES) {
        const float side = j < NV ? 1.0f * (moves2[j] - moves1[j]) : 0.0f;
        wp::vec3 turn, move;
        if (side != 0.0f) {
            const auto dof = row_of(p.cdof)[j];
            const auto com = row_of(p.subtree_com)[p.body_rootid.data[p.dof_bodyid.data[j]]];
            turn = side * wp::vec3(dof[0], dof[1], dof[2]);
            move = side * wp::vec3(dof[3], dof[4], dof[5]) + wp::cross(turn, p.pos.data[i] - com);
        }
        #pragma unroll
        for (int k = 0; k < 3; ++k) {
            E[k * N + j] = turn[k];
            E[(k + 3) * N + j] = move[k];
        }
    }
}

// of this lane's degrees of freedom; 0 where it has none
float x[OWN], Mx[OWN], g[OWN], d[OWN], Md[OWN];
const bool free = plain == 0 && contacts == 0;
float trace = 0.0f;
for (int s = 0; s < OWN; ++s) {
    const int j = lane + s * LANES;
    x[s] = Mx[s] = g[s] = d[s] = Md[s] = 0.0f;
    if (j >= NV) continue;
    for (int i = 0; i < NV; ++i) M[i * N + j] = 0.0f;
    for (int k = p.begin.data[j]; k < p.begin.data[j + 1]; ++k)
        M[p.column.data[k] * N + j] = row_of(p.M)[p.place.data[k]];
    trace += M[j * N + j];
    x[s] = free ? 0.0f : row_of(p.qacc_warmstart)[j];  // from 0 one step is exact
}
const float scale = 1.0f / wp::max(1e-15f, sum(trace));
const float tolerance = p.tolerance.data[0];

auto share = [&](const float* a) {  // in v
    sync();
    for (int j = lane; j < N; j += LANES) v[j] = j < NV ? a[j / LANES] : 0.0f;
    sync();
};
auto by_mass = [&](float* Ma) {  // M v
    for (int s = 0; s < OWN; ++s) {
        const int j = lane + s * LANES;
        float total = 0.0f;
        if (j < NV)
            for (int i = 0; i < NV; ++i) total += M[i * N + j] * v[i];
        Ma[s] = total;
    }
};
auto twists = [&] {  // E v
    #pragma unroll 1
    for (int row = lane; row < 6 * pairs; row += LANES) {
        float* of = joined + row / 6 * PARTS;
        of[TWIST + row % 6] = dot(of + row % 6 * N, v);
    }
    sync();
};
auto read = [&](int c, float* f) {  // the first 32 numbers of a contact
    #pragma unroll
    for (int q = 0; q < 8; ++q) *(Quad*)(f + 4 * q) = ((const Quad*)(touch + c * FIELDS))[q];
};
auto slip = [&](int c, float* a) {  // a pair's twist in a contact's directions
    const float *f = touch + c * FIELDS, *t = joined + whole(c, PAIR) * PARTS + TWIST;
    const wp::vec3 turn(t[0], t[1], t[2]), arm(f[ARM], f[ARM + 1], f[ARM + 2]);
    const wp::vec3 move = wp::vec3(t[3], t[4], t[5]) + wp::cross(turn, arm);
    #pragma unroll
    for (int k = 0; k < 3; ++k) {
        const wp::vec3 axis(f[3 * k], f[3 * k + 1], f[3 * k + 2]);
        a[k] = wp::dot(axis, move);
        a[k + 3] = wp::dot(axis, turn);
    }
};

share(x);
by_mass(Mx);
twists();
#pragma unroll 1
for (int row = lane; row < plain; row += LANES) {
    residual[row] = dot(J + row * wide, v) - aref[row];
    slope[row] = curvature[row] = 0.0f;
}
#pragma unroll 1
for (int c = lane; c < contacts; c += LANES) {
    const int i = whole(c, PLACE);
    float* f = touch + c * FIELDS;
    const wp::vec3 arm = p.pos.data[i] - p.pos.data[lead(whole(c, PAIR))];
    for (int k = 0; k < 3; ++k) {
        for (int j = 0; j < 3; ++j) f[3 * k + j] = p.frame.data[i].data[k][j];
        f[ARM + k] = arm[k];
    }
    // a contact without friction: two rows, each half as stiff, both along the normal
    const int dim = p.dim.data[i];
    for (int k = 0; k < 5; ++k) f[FRICTION + k] = dim == 1 ? 0.0f : p.friction.data[i][k];
    f[STIFFNESS] = p.soft.data[i][0] * (dim == 1 ? 0.5f : 1.0f);
    f[SIDES] = wp::max(1, dim - 1);
    slip(c, f + OFF);
    f[OFF] += p.soft.data[i][1];
    whole(c, PUSHES) = 0;
}
float velocity[OWN];
for (int s = 0; s < OWN; ++s)
    velocity[s] = lane + s * LANES < NV ? row_of(p.qvel)[lane + s * LANES] : 0.0f;
share(velocity);
twists();
#pragma unroll 1
for (int c = lane; c < contacts; c += LANES) {
    float a[6];
    slip(c, a);
    const float damping = p.soft.data[whole(c, PLACE)][2];
    for (int k = 0; k < 6; ++k) {
        touch[c * FIELDS + OFF + k] += damping * a[k];
        touch[c * FIELDS + RATE + k] = 0.0f;
    }
}

// force -s' and curvature s'' of a plain row: equalities come first, then dry friction, then what only
// pushes
auto pull = [&](int row, float at, float& bent) {
    bent = D[row];
    if (row >= equal + dry && at >= 0.0f) bent = 0.0f;
    if (row >= equal && row < equal + dry && wp::abs(at) * D[row] >= loss[row]) {
        bent = 0.0f;
        return at < 0.0f ? loss[row] : -loss[row];
    }
    return -bent * at;
};

int steps = 0;
float alpha = 0.0f, decrement = 0.0f;  // g' H^-1 g
while (steps <= p.iterations) {  // always; with `true` the compiler needs eight times the stack
    // where the last step has led
    float changes = dry;  // always some: the two linear pieces of dry friction have the same curvature
    #pragma unroll 1
    for (int row = lane; row < plain; row += LANES) {
        const float at = residual[row] + alpha * slope[row];
        float bent;
        force[row] = pull(row, at, bent);
        residual[row] = at;
        changes += bent != curvature[row];
        curvature[row] = bent;
    }
    float total[(SUMS + LANES - 1) / LANES] = {};
    for (int start = 0; start < contacts; start += CHUNK) {
        const int end = wp::min(start + CHUNK, contacts);
        for (int c = start + lane; c < end; c += LANES) {
            alignas(16) float f[32];
            read(c, f);
            const float stiffness = f[STIFFNESS];
            const int sides = f[SIDES];
            float a[6];
            #pragma unroll
            for (int k = 0; k < 6; ++k) touch[c * FIELDS + OFF + k] = a[k] = f[OFF + k] + alpha * f[RATE + k];
            // S, the curvature of the pyramid of rows a_0 +- friction_k a_k: its first row and diagonal
            float first[6] = {}, diagonal[6] = {};
            int pushing = 0;
            #pragma unroll
            for (int k = 1; k < 6; ++k) {
                if (k > sides) continue;
                const float friction = f[FRICTION + k - 1], side = friction * a[k];
                const bool more = a[0] + side < 0.0f, less = a[0] - side < 0.0f;
                pushing |= (more | less << 1) << 2 * k;
                first[0] += stiffness * (more + less);
                first[k] = stiffness * friction * (more - less);
                diagonal[k] = stiffness * friction * friction * (more + less);
            }
            changes += pushing != whole(c, PUSHES);
            whole(c, PUSHES) = pushing;
            // C: what each direction, slip along the axes and turns about them, is of the pair's twist
            float C[6][6], SC[6][6] = {}, Sa[6];
            #pragma unroll
            for (int k = 0; k < 3; ++k)
                #pragma unroll
                for (int i = 0; i < 3; ++i) {
                    const int j = (i + 1) % 3, l = (i + 2) % 3;
                    C[k][i + 3] = C[k + 3][i] = f[3 * k + i];
                    C[k][i] = f[ARM + j] * f[3 * k + l] - f[ARM + l] * f[3 * k + j];
                    C[k + 3][i + 3] = 0.0f;
                }
            Sa[0] = first[0] * a[0];
            #pragma unroll
            for (int i = 0; i < 6; ++i) SC[0][i] = first[0] * C[0][i];
            #pragma unroll
            for (int k = 1; k < 6; ++k) {
                Sa[0] += first[k] * a[k];
                Sa[k] = first[k] * a[0] + diagonal[k] * a[k];
                #pragma unroll
                for (int i = 0; i < 6; ++i) {
                    if (k < 3 || i < 3) SC[0][i] += first[k] * C[k][i];
                    SC[k][i] = first[k] * C[0][i] + (k < 3 || i < 3 ? diagonal[k] * C[k][i] : 0.0f);
                }
            }
            float* mine = part + (c - start) * (SUMS + 1);  // odd, for the banks
            #pragma unroll
            for (int i = 0; i < 6; ++i) {
                float wrench = 0.0f;
                #pragma unroll
                for (int k = 0; k < (i < 3 ? 6 : 3); ++k) wrench -= C[k][i] * Sa[k];
                mine[WRENCH + i] = wrench;
                #pragma unroll
                for (int j = 0; j <= i; ++j) {
                    float entry = 0.0f;
                    #pragma unroll
                    for (int k = 0; k < (i < 3 ? 6 : 3); ++k) entry += C[k][i] * SC[k][j];
                    mine[i * (i + 1) / 2 + j] = entry;
                }
            }
        }
        sync();
        for (int e = lane; e < SUMS - 1; e += LANES)
            for (int c = start; c < end; ++c) {
                total[e / LANES] += part[(c - start) * (SUMS + 1) + e];
                const int pair = whole(c, PAIR);
                if (c + 1 < contacts && whole(c + 1, PAIR) == pair) continue;
                joined[pair * PARTS + TOTALS + e] = total[e / LANES];
                total[e / LANES] = 0.0f;
            }
        sync();
    }
    changes = sum(changes);
    sync();

    const float left = 1.0f - alpha;
    if (steps > 0 && changes == 0.0f && scale * 0.5f * decrement * left * left < tolerance) {
        for (int s = 0; s < OWN; ++s) g[s] *= left;  // all of the step was quadratic
        break;
    }
    // H, a column a lane, and g
    float H[OWN][N];
    for (int s = 0; s < OWN; ++s) {
        const int j = wp::min(lane + s * LANES, NV - 1);
        #pragma unroll
        for (int i = 0; i < N; ++i) H[s][i] = i < NV ? M[i * N + j] : 0.0f;
        g[s] = Mx[s] - smooth[j];
        #pragma unroll 1
        for (int row = 0; row < plain; ++row) {
            const float* rows = J + row * wide;
            g[s] -= force[row] * rows[j];
            add(H[s], curvature[row] * rows[j], rows);
        }
        #pragma unroll 1
        for (int q = 0; q < pairs; ++q) {
            const float *rows = joined + q * PARTS, *sums = rows + TOTALS;
            alignas(16) float A[SUMS];
            float own[6];
            #pragma unroll
            for (int e = 0; e < SUMS; e += 4) *(Quad*)(A + e) = *(const Quad*)(sums + e);
            #pragma unroll
            for (int k = 0; k < 6; ++k) {
                own[k] = rows[k * N + j];
                g[s] -= A[WRENCH + k] * own[k];
            }
            #pragma unroll
            for (int k = 0; k < 6; ++k) {
                float weight = 0.0f;
                #pragma unroll
                for (int l = 0; l < 6; ++l)
                    weight += A[k > l ? k * (k + 1) / 2 + l : l * (l + 1) / 2 + k] * own[l];
                add(H[s], weight, rows + k * N);
            }
        }
        if (lane + s * LANES >= NV) g[s] = 0.0f;
    }
    for (int s = 0; s < OWN; ++s) d[s] = -g[s];
    eliminate(H, d);
    float descent = 0.0f;
    for (int s = 0; s < OWN; ++s) descent -= g[s] * d[s];
    decrement = sum(descent);
    if (steps > 0 && !(scale * 0.5f * decrement >= tolerance)) break;  // also NaN
    if (steps == p.iterations) {
        if (lane == 0) p.overflow.data[world] |= p.full;
        break;
    }

    share(d);
    by_mass(Md);
    twists();
    #pragma unroll 1
    for (int row = lane; row < plain; row += LANES) slope[row] = dot(J + row * wide, v);
    #pragma unroll 1
    for (int c = lane; c < contacts; c += LANES) {
        slip(c, touch + c * FIELDS + RATE);
    }
    // of the smooth cost along d: slope at 0, curvature; and |d|^2
    float rise0 = 0.0f, bent0 = 0.0f, length = 0.0f;
    for (int s = 0; s < OWN; ++s) {
        const int j = wp::min(lane + s * LANES, NV - 1);
        rise0 += d[s] * (Mx[s] - smooth[j]);
        bent0 += d[s] * Md[s];
        length += d[s] * d[s];
    }
    rise0 = sum(rise0);
    bent0 = sum(bent0);
    const float flat = tolerance * p.ls_tolerance.data[0] * wp::sqrt(sum(length)) / scale;

    // to where the slope along d vanishes
    float low = 0.0f, high = INFINITY;
    alpha = 1.0f;
    for (int trial = 0; trial < p.ls_iterations; ++trial) {
        float rise = 0.0f, bent = 0.0f, size = 0.0f;  // slope, curvature, size of what the slope sums
        #pragma unroll 1
        for (int row = lane; row < plain; row += LANES) {
            float bends;
            const float pulls = -pull(row, residual[row] + alpha * slope[row], bends) * slope[row];
            rise += pulls;
            size += wp::abs(pulls);
            bent += bends * slope[row] * slope[row];
        }
        #pragma unroll 1
        for (int c = lane; c < contacts; c += LANES) {
            alignas(16) float f[32];
            read(c, f);
            const float stiffness = f[STIFFNESS], change = f[RATE], at = f[OFF] + alpha * change;
            const int sides = f[SIDES];
            #pragma unroll
            for (int k = 1; k < 6; ++k) {
                if (k > sides) continue;
                const float friction = f[FRICTION + k - 1];
                const float along = friction * f[RATE + k];
                const float side = friction * f[OFF + k] + alpha * along;
                #pragma unroll
                for (int sign = -1; sign < 2; sign += 2) {
                    const float depth = wp::min(0.0f, at + sign * side), way = change + sign * along;
                    rise += stiffness * depth * way;
                    size += stiffness * wp::abs(depth * way);
                    if (depth < 0.0f) bent += stiffness * way * way;
                }
            }
        }
        rise = rise0 + alpha * bent0 + sum(rise);
        bent = bent0 + sum(bent);
        size = wp::abs(rise0) + alpha * bent0 + sum(size);
        if (!(wp::abs(rise) > wp::max(flat, ROUNDING * size))) break;
        (rise < 0.0f ? low : high) = alpha;
        float next = alpha - rise / bent;
        if (next == alpha) break;
        if (next <= low || next >= high) next = 0.5f * (low + high);
        alpha = next;
    }
    if (alpha < ROUNDING) break;  // downhill is lost in rounding
    ++steps;
    for (int s = 0; s < OWN; ++s) {
        x[s] += alpha * d[s];
        Mx[s] += alpha * Md[s];
    }
    sync();
}

for (int s = 0; s < OWN; ++s) {
    const int j = lane + s * LANES;
    if (j >= NV) continue;
    row_of(p.qacc)[j] = x[s];
    row_of(p.Ma)[j] = Mx[s];
    row_of(p.qfrc_constraint)[j] = free ? 0.0f : Mx[s] - smooth[j] - g[s];
}
#pragma unroll 1
for (int c = lane; c < contacts; c += LANES) {
    const int i = whole(c, PLACE), first = at_row(p.address, i)[0];
    const float* f = touch + c * FIELDS;
    const int sides = f[SIDES];
    for (int k = 1; k <= sides; ++k) {
        const float side = f[FRICTION + k - 1] * f[OFF + k];
        const float more = -f[STIFFNESS] * wp::min(0.0f, f[OFF] + side);
        const float less = -f[STIFFNESS] * wp::min(0.0f, f[OFF] - side);
        force[first + 2 * k - 2] = p.dim.data[i] == 1 ? more + less : more;
        if (p.dim.data[i] > 1) force[first + 2 * k - 1] = less;
    }
}
if (lane == 0) p.niter.data[world] = free ? 0 : steps;  // as MuJoCo counts
