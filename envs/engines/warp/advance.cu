// A step from the accelerations of a forward pass: the body of a function in dynamics.py, after lanes.cu.
// DAMPED and EULER are constants, p, stage, world and thread its arguments.
//
// EULER: a semi-implicit step; if DAMPED the forces of dampers are taken at its end.
// Else stage 0 to 3 is one of the four of Runge and Kutta. Each of the first three goes from the start to
// where the next forward pass looks; the last goes from the start to the end, by the mean of all.

#if defined(__CUDA_ARCH__)
__shared__ float masses[WORLDS][DAMPED ? NV * N : 1], rates[WORLDS][NV];
#else
static float masses[WORLDS][DAMPED ? NV * N : 1], rates[WORLDS][NV];
#endif
float *M = masses[place_in_block], *v = rates[place_in_block];

const bool first = stage == 0, last = EULER || stage == 3;
const float weight = first || last ? 1.0f / 6.0f : 1.0f / 3.0f;
const float h = p.timestep.data[0] * (EULER || stage > 1 ? 1.0f : 0.5f);  // how far to go
const float *qacc = row_of(p.qacc), *Ma = row_of(p.Ma);
float change[OWN], H[OWN][N];  // of the velocity, per second
for (int s = 0; s < OWN; ++s) {
    const int j = lane + s * LANES;
    change[s] = j < NV ? (DAMPED ? Ma : qacc)[j] : 0.0f;
    if (!DAMPED || j >= NV) continue;
    for (int i = 0; i < NV; ++i) M[i * N + j] = 0.0f;
    for (int k = p.begin.data[j]; k < p.begin.data[j + 1]; ++k)
        M[p.column.data[k] * N + j] = row_of(p.M)[p.place.data[k]];
    M[j * N + j] += h * p.dof_damping.data[j];
}
if (DAMPED) {  // (M + h damping) change = M qacc
    for (int s = 0; s < OWN; ++s) {
        const int j = lane + s * LANES;
        #pragma unroll
        for (int i = 0; i < N; ++i) H[s][i] = i < NV && j < NV ? M[i * N + j] : 0.0f;
    }
    eliminate(H, change);
}
// the velocity afterwards, and in v the one at which positions go there
for (int s = 0; s < OWN; ++s) {
    const int j = lane + s * LANES;
    if (j >= NV) continue;
    float& now = row_of(p.qvel)[j];
    if (EULER) {
        v[j] = now += h * change[s];
    } else {
        float &start = row_of(p.start_qvel)[j], &rate = row_of(p.mean_qvel)[j];
        float& rise = row_of(p.mean_qacc)[j];
        if (first) start = now;
        rate = (first ? 0.0f : rate) + weight * now;
        rise = (first ? 0.0f : rise) + weight * change[s];
        v[j] = last ? rate : now;
        now = start + h * (last ? rise : change[s]);
    }
    if (last) row_of(p.qacc_warmstart)[j] = qacc[j];
}
float* qpos = row_of(p.qpos);
if (!EULER) {
    float* start = row_of(p.start_qpos);
    for (int i = lane; i < p.start_qpos.shape[1]; i += LANES) (first ? start : qpos)[i] = (first ? qpos : start)[i];
}
sync();

for (int j = lane; j < p.jnt_type.shape[0]; j += LANES) {
    const int kind = p.jnt_type.data[j];
    float *q = qpos + p.jnt_qposadr.data[j], *rate = v + p.jnt_dofadr.data[j];
    if (kind == HINGE || kind == SLIDE) q[0] += h * rate[0];
    if (kind == FREE) {
        for (int k = 0; k < 3; ++k) q[k] += h * rate[k];
        q += 3;
        rate += 3;
    }
    if (kind == FREE || kind == BALL) {
        const float speed = wp::sqrt(rate[0] * rate[0] + rate[1] * rate[1] + rate[2] * rate[2]);
        const float c = wp::cos(0.5f * h * speed);
        const float by = speed > 0.0f ? wp::sin(0.5f * h * speed) / speed : 0.0f;
        const float x = by * rate[0], y = by * rate[1], z = by * rate[2];
        const float turned[4] = {
            q[0] * c - q[1] * x - q[2] * y - q[3] * z,
            q[0] * x + q[1] * c + q[2] * z - q[3] * y,
            q[0] * y - q[1] * z + q[2] * c + q[3] * x,
            q[0] * z + q[1] * y - q[2] * x + q[3] * c,
        };
        float size = 0.0f;
        for (int k = 0; k < 4; ++k) size += turned[k] * turned[k];
        for (int k = 0; k < 4; ++k) q[k] = turned[k] / wp::sqrt(size);
    }
}
if (lane == 0) {
    if (last) p.time.data[world] += h;
    if (p.nefc.data[world] > p.rows) p.overflow.data[world] |= NO_NEFC;
    if (p.ncollision.data[0] > p.contacts) p.overflow.data[world] |= NO_BROADPHASE;
    if (p.nacon.data[0] > p.contacts) p.overflow.data[world] |= NO_NARROWPHASE;
}
