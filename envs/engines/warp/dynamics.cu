// All that a state says before contacts: poses, inertia, velocities, forces without constraints. The
// body of a function in dynamics.py; BODIES, JOINTS, DOFS, ACTUATORS, FLUID, LANES, WORLDS (of a
// block) and SHARED are constants there, p, for_sensors, block and thread its arguments. LANES threads
// share a world.

#if defined(__CUDA_ARCH__)
__shared__ float memory[WORLDS][SHARED];
const unsigned mates = (LANES == 32 ? ~0u : (1u << LANES % 32) - 1u) << thread / LANES * LANES;
auto sync = [=] { __syncwarp(mates); };
#else
static float memory[WORLDS][SHARED];
auto sync = [] { WP_TILE_SYNC(); };
#endif

const int lane = thread % LANES, world = block * WORLDS + thread / LANES;
if (world >= p.qpos.shape[0]) return;
if (lane == 0) {  // nothing constrains yet
    p.ne.data[world] = p.nf.data[world] = p.nl.data[world] = p.nefc.data[world] = 0;
    p.count.data[world] = 0;
    if (world == 0) p.nacon.data[0] = p.ncollision.data[0] = 0;
}

struct Quat { float w, x, y, z; };
struct Motion { wp::vec3 turn, move; };  // also a force: torque, force
auto vec = [](const float* a) { return wp::vec3(a[0], a[1], a[2]); };
auto put = [](float* to, const wp::vec3& a) {
    #pragma unroll
    for (int k = 0; k < 3; ++k) to[k] = a[k];
};
auto quat = [](const float* a) { return Quat{a[0], a[1], a[2], a[3]}; };
auto put_quat = [](float* to, const Quat& a) {
    to[0] = a.w; to[1] = a.x; to[2] = a.y; to[3] = a.z;
};
auto unit = [](const Quat& a) {
    const float size = wp::sqrt(a.w * a.w + a.x * a.x + a.y * a.y + a.z * a.z);
    return size > 0.0f ? Quat{a.w / size, a.x / size, a.y / size, a.z / size} : a;
};
auto times = [](const Quat& a, const Quat& b) {
    return Quat{
        a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z,
        a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
        a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
        a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w,
    };
};
auto rotate = [](const wp::vec3& a, const Quat& q) {
    const wp::vec3 u(q.x, q.y, q.z);
    return 2.0f * wp::dot(u, a) * u + (q.w * q.w - wp::dot(u, u)) * a + 2.0f * q.w * wp::cross(u, a);
};
auto matrix = [](const Quat& q, float* m) {  // its columns are the turned axes
    m[0] = q.w * q.w + q.x * q.x - q.y * q.y - q.z * q.z;
    m[1] = 2.0f * (q.x * q.y - q.w * q.z);
    m[2] = 2.0f * (q.x * q.z + q.w * q.y);
    m[3] = 2.0f * (q.x * q.y + q.w * q.z);
    m[4] = q.w * q.w - q.x * q.x + q.y * q.y - q.z * q.z;
    m[5] = 2.0f * (q.y * q.z - q.w * q.x);
    m[6] = 2.0f * (q.x * q.z - q.w * q.y);
    m[7] = 2.0f * (q.y * q.z + q.w * q.x);
    m[8] = q.w * q.w - q.x * q.x - q.y * q.y + q.z * q.z;
};
auto motion = [&](const float* a) { return Motion{vec(a), vec(a + 3)}; };
auto put_motion = [&](float* to, const Motion& a) {
    put(to, a.turn);
    put(to + 3, a.move);
};
auto inner = [](const Motion& a, const Motion& b) {
    return wp::dot(a.turn, b.turn) + wp::dot(a.move, b.move);
};
auto add = [](Motion& a, float weight, const Motion& b) {
    a.turn += weight * b.turn;
    a.move += weight * b.move;
};
auto momentum = [](const float* i, const Motion& v) {  // i: 6 of inertia, mass x arm, mass
    const wp::vec3 w = v.turn, arm(i[6], i[7], i[8]);
    const wp::vec3 spin(
        i[0] * w[0] + i[3] * w[1] + i[4] * w[2],
        i[3] * w[0] + i[1] * w[1] + i[5] * w[2],
        i[4] * w[0] + i[5] * w[1] + i[2] * w[2]);
    return Motion{spin + wp::cross(arm, v.move), i[9] * v.move - wp::cross(arm, w)};
};
auto at = [&](const auto& a) {  // the first float of this world
    return (float*)((char*)a.data + (size_t)world * a.strides[0]);
};

float* pos = memory[thread / LANES];  // [BODIES][3]
float* turn = pos + 3 * BODIES;  // [BODIES][4]
float* inert = turn + 4 * BODIES;  // [BODIES][10] about the centre of mass of the tree
float* whole = inert + 10 * BODIES;  // [BODIES][10] with all that a body carries
float* load = whole + 10 * BODIES;  // [BODIES][6] force that its motion takes
float* anchor = load + 6 * BODIES;  // [JOINTS][3]
float* axis = anchor + 3 * JOINTS;  // [JOINTS][3]
float* S = axis + 3 * JOINTS;  // [DOFS][6] motion of a unit of velocity
float* dS = S + 6 * DOFS;  // [DOFS][6] its rate
float* v = dS + 6 * DOFS;  // [DOFS]
float* push = v + DOFS;  // [ACTUATORS]
static_assert(33 * BODIES + 6 * JOINTS + 13 * DOFS + ACTUATORS == SHARED, "memory");

const float *qpos = at(p.qpos), *model_pos = (float*)p.body_pos.data;
const float* model_quat = (float*)p.body_quat.data;

// poses, from the root of each tree outwards
for (int i = lane; i < DOFS; i += LANES) v[i] = at(p.qvel)[i];
for (int level = 0; level < p.levels; ++level) {
    for (int b = lane; b < BODIES; b += LANES) {
        if (p.body_level.data[b] != level) continue;
        const int parent = p.body_parentid.data[b], guide = p.body_mocapid.data[b];
        const int first = p.body_jntadr.data[b], joints = p.body_jntnum.data[b];
        wp::vec3 x;
        Quat q{1.0f, 0.0f, 0.0f, 0.0f};
        if (joints == 1 && p.jnt_type.data[first] == FREE) {
            const float* at_joint = qpos + p.jnt_qposadr.data[first];
            x = vec(at_joint);
            q = unit(quat(at_joint + 3));
            put(anchor + 3 * first, x);
        } else if (b > 0) {
            x = vec(guide >= 0 ? at(p.mocap_pos) + 3 * guide : model_pos + 3 * b);
            q = quat(guide >= 0 ? at(p.mocap_quat) + 4 * guide : model_quat + 4 * b);
            if (parent > 0) {
                const Quat base = quat(turn + 4 * parent);
                x = rotate(x, base) + vec(pos + 3 * parent);
                q = times(base, q);
            }
            for (int j = first; j < first + joints; ++j) {
                const int kind = p.jnt_type.data[j], address = p.jnt_qposadr.data[j];
                const wp::vec3 arm = vec((float*)p.jnt_pos.data + 3 * j);
                const wp::vec3 along = vec((float*)p.jnt_axis.data + 3 * j);
                const wp::vec3 fixed = rotate(arm, q) + x;
                put(anchor + 3 * j, fixed);
                put(axis + 3 * j, rotate(along, q));
                const float by = qpos[address] - p.qpos0.data[address];
                if (kind == SLIDE) {
                    x += by * rotate(along, q);
                    continue;
                }
                const wp::vec3 half = wp::sin(0.5f * by) * along;
                const Quat hinge{wp::cos(0.5f * by), half[0], half[1], half[2]};
                q = times(q, kind == BALL ? unit(quat(qpos + address)) : hinge);
                x = fixed - rotate(arm, q);
            }
            q = unit(q);
        }
        put(pos + 3 * b, x);
        put_quat(turn + 4 * b, q);
        put(at(p.xpos) + 3 * b, x);
        put_quat(at(p.xquat) + 4 * b, q);
        matrix(q, at(p.xmat) + 9 * b);
    }
    sync();
}

auto centre = [&](int b) {  // of mass, of a body
    return vec(pos + 3 * b) + rotate(vec((float*)p.body_ipos.data + 3 * b), quat(turn + 4 * b));
};
auto place = [&](int b, const float* offset, const float* spin, float* to, float* to_matrix) {
    const Quat q = quat(turn + 4 * b);
    put(to, vec(pos + 3 * b) + rotate(vec(offset), q));
    matrix(times(q, quat(spin)), to_matrix);
};
for (int g = lane; g < p.geom_bodyid.shape[0]; g += LANES)
    if (p.geom_moves.data[g])
        place(
            p.geom_bodyid.data[g], (float*)p.geom_pos.data + 3 * g, (float*)p.geom_quat.data + 4 * g,
            at(p.geom_xpos) + 3 * g, at(p.geom_xmat) + 9 * g);
for (int s = lane; s < p.site_bodyid.shape[0]; s += LANES)
    place(
        p.site_bodyid.data[s], (float*)p.site_pos.data + 3 * s, (float*)p.site_quat.data + 4 * s,
        at(p.site_xpos) + 3 * s, at(p.site_xmat) + 9 * s);

// inertia and axes about the centre of mass of their tree
for (int b = 1 + lane; b < BODIES; b += LANES) {
    const int root = p.body_rootid.data[b];
    wp::vec3 com;
    for (int k = root; k < p.body_end.data[root]; ++k) com += p.body_mass.data[k] * centre(k);
    const float tree = p.body_subtreemass.data[root], mass = p.body_mass.data[b];
    com = tree > 0.0f ? com / tree : com;
    if (b == root) put(at(p.subtree_com) + 3 * b, com);
    float m[9], sum[6];
    const wp::vec3 own = vec((float*)p.body_inertia.data + 3 * b), arm = centre(b) - com;
    matrix(times(quat(turn + 4 * b), quat((float*)p.body_iquat.data + 4 * b)), m);
    #pragma unroll
    for (int e = 0; e < 6; ++e) {
        const int i = e < 3 ? e : e == 5, j = e < 3 ? e : e == 3 ? 1 : 2;
        sum[e] = (e < 3 ? mass * wp::dot(arm, arm) : 0.0f) - mass * arm[i] * arm[j];
        #pragma unroll
        for (int k = 0; k < 3; ++k) sum[e] += own[k] * m[3 * i + k] * m[3 * j + k];
        inert[10 * b + e] = sum[e];
    }
    put(inert + 10 * b + 6, mass * arm);
    inert[10 * b + 9] = mass;
    for (int j = p.body_jntadr.data[b]; j < p.body_jntadr.data[b] + p.body_jntnum.data[b]; ++j) {
        float* out = S + 6 * p.jnt_dofadr.data[j];
        const int kind = p.jnt_type.data[j];
        const wp::vec3 offset = com - vec(anchor + 3 * j), along = vec(axis + 3 * j);
        if (kind == SLIDE) put_motion(out, Motion{wp::vec3(), along});
        if (kind == HINGE) put_motion(out, Motion{along, wp::cross(along, offset)});
        if (kind == FREE)
            for (int k = 0; k < 3; ++k, out += 6)
                put_motion(out, Motion{wp::vec3(), wp::vec3(k == 0, k == 1, k == 2)});
        if (kind == FREE || kind == BALL) {
            matrix(quat(turn + 4 * b), m);
            for (int k = 0; k < 3; ++k, out += 6) {
                const wp::vec3 column(m[k], m[3 + k], m[6 + k]);
                put_motion(out, Motion{column, wp::cross(column, offset)});
            }
        }
    }
}
sync();

// velocities and rates of the axes
auto velocity = [&](int i) {  // due to a degree of freedom and those before it
    Motion sum{};
    for (; i >= 0; i = p.dof_parentid.data[i]) add(sum, v[i], motion(S + 6 * i));
    return sum;
};
for (int i = lane; i < DOFS; i += LANES) {
    const Motion own = motion(S + 6 * i), base = velocity(p.dof_before.data[i]);
    const Motion rate{
        wp::cross(base.turn, own.turn),
        wp::cross(base.move, own.turn) + wp::cross(base.turn, own.move)};
    put_motion(dS + 6 * i, rate);
    put_motion(at(p.cdof) + 6 * i, own);
    put_motion(at(p.cdof_dot) + 6 * i, rate);
}
for (int b = 1 + lane; b < BODIES; b += LANES)
    for (int e = 0; e < 10; ++e) {
        float sum = 0.0f;
        for (int k = b; k < p.body_end.data[b]; ++k) sum += inert[10 * k + e];
        whole[10 * b + e] = sum;
    }
for (int a = lane; a < ACTUATORS; a += LANES) {
    const float* range = (float*)p.actuator_ctrlrange.data + 2 * a;
    const float *gain = p.actuator_gainprm.data[a].c, *bias = p.actuator_biasprm.data[a].c;
    const float gear = p.actuator_gear.data[a].c[0];
    float force = at(p.ctrl)[a];
    if (p.actuator_ctrllimited.data[a]) force = wp::clamp(force, range[0], range[1]);
    force *= gain[0];
    if (p.actuator_biastype.data[a] == AFFINE) {  // on a joint
        const int j = p.actuator_trnid.data[a][0];
        force += bias[0] + bias[1] * gear * qpos[p.jnt_qposadr.data[j]]
            + bias[2] * gear * v[p.jnt_dofadr.data[j]];
    }
    range = (float*)p.actuator_forcerange.data + 2 * a;
    if (p.actuator_forcelimited.data[a]) force = wp::clamp(force, range[0], range[1]);
    push[a] = force;
}
sync();

// what a fluid does to a body whose box of the same inertia moves through it
auto drag = [&](int b, const Motion& rate) {
    const float mass = p.body_mass.data[b];
    if (mass < 1e-15f) return Motion{};
    const Quat q = times(quat(turn + 4 * b), quat((float*)p.body_iquat.data + 4 * b));
    const Quat back{q.w, -q.x, -q.y, -q.z};
    const wp::vec3 arm = centre(b) - vec(at(p.subtree_com) + 3 * p.body_rootid.data[b]);
    const wp::vec3 through = rate.move + wp::cross(rate.turn, arm) - vec((float*)p.wind.data);
    const wp::vec3 spin = rotate(rate.turn, back), speed = rotate(through, back);
    const float* own = (float*)p.body_inertia.data + 3 * b;
    const float density = p.density.data[0], viscosity = p.viscosity.data[0];
    float side[3], fourth[3], mean = 0.0f;
    for (int k = 0; k < 3; ++k) {
        const float others = own[(k + 1) % 3] + own[(k + 2) % 3] - own[k];
        side[k] = wp::sqrt(wp::max(1e-15f, others) / mass * 6.0f);
        fourth[k] = side[k] * side[k] * side[k] * side[k];
        mean += side[k] / 3.0f;
    }
    constexpr float PI = 3.14159265358979f;
    float torque[3], force[3];
    for (int k = 0; k < 3; ++k) {
        const int i = (k + 1) % 3, j = (k + 2) % 3;
        torque[k] = -PI * mean * mean * mean * viscosity * spin[k]
            - density * side[k] * (fourth[i] + fourth[j]) * wp::abs(spin[k]) * spin[k] / 64.0f;
        force[k] = -3.0f * PI * mean * viscosity * speed[k]
            - 0.5f * density * side[i] * side[j] * wp::abs(speed[k]) * speed[k];
    }
    const wp::vec3 push = rotate(vec(force), q);
    return Motion{rotate(vec(torque), q) + wp::cross(arm, push), push};
};

// what motion as it is takes: Newton and Euler's equations of each body
for (int b = 1 + lane; b < BODIES; b += LANES) {
    const Motion rate = velocity(p.body_deepest.data[b]);
    Motion acceleration{wp::vec3(), -vec((float*)p.gravity.data)};
    for (int i = p.body_deepest.data[b]; i >= 0; i = p.dof_parentid.data[i])
        add(acceleration, v[i], motion(dS + 6 * i));
    const Motion along = momentum(inert + 10 * b, rate);
    Motion force = momentum(inert + 10 * b, acceleration);
    force.turn += wp::cross(rate.turn, along.turn) + wp::cross(rate.move, along.move);
    force.move += wp::cross(rate.turn, along.move);
    if (FLUID) add(force, -1.0f, drag(b, rate));
    put_motion(load + 6 * b, force);
    put_motion(at(p.cvel) + 6 * b, rate);
    if (for_sensors)
        for (int e = 0; e < 10; ++e) at(p.cinert)[10 * b + e] = inert[10 * b + e];
}
// M, a row a degree of freedom: with itself and those before it, or where they do not depend on each other
// with itself alone
for (int i = lane; i < DOFS; i += LANES) {
    const Motion along = momentum(whole + 10 * p.dof_bodyid.data[i], motion(S + 6 * i));
    float* row = at(p.M) + p.M_rowadr.data[i];
    for (int e = p.M_rownnz.data[i] - 1, k = i; e >= 0; --e, k = p.dof_parentid.data[k])
        row[e] = inner(motion(S + 6 * k), along) + (k == i ? p.dof_armature.data[i] : 0.0f);
}
sync();
for (int i = lane; i < DOFS; i += LANES) {
    const int body = p.dof_bodyid.data[i], j = p.dof_jntid.data[i];
    const Motion own = motion(S + 6 * i);
    float force = -p.dof_damping.data[i] * v[i];
    if (p.jnt_stiffness.data[j] != 0.0f) {
        const int address = p.jnt_qposadr.data[j];
        force -= p.jnt_stiffness.data[j] * (qpos[address] - p.qpos_spring.data[address]);
    }
    for (int b = body; b < p.body_end.data[body]; ++b) force -= inner(own, motion(load + 6 * b));
    for (int a = 0; a < ACTUATORS; ++a) {
        const float* gear = p.actuator_gear.data[a].c;
        const int id = p.actuator_trnid.data[a][0];
        if (p.actuator_trntype.data[a] != ON_SITE) {
            if (id == j) force += gear[0] * push[a];
            continue;
        }
        const int on = p.site_bodyid.data[id];
        if (!(body <= on && on < p.body_end.data[body])) continue;
        const Quat q = times(quat(turn + 4 * on), quat((float*)p.site_quat.data + 4 * id));
        const wp::vec3 point = rotate(vec((float*)p.site_pos.data + 3 * id), quat(turn + 4 * on))
            + vec(pos + 3 * on) - vec(at(p.subtree_com) + 3 * p.body_rootid.data[on]);
        force += push[a] * (wp::dot(own.move + wp::cross(own.turn, point), rotate(vec(gear), q))
            + wp::dot(own.turn, rotate(vec(gear + 3), q)));
    }
    at(p.qfrc_smooth)[i] = force;
}
