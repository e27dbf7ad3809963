// Euler's step, semi-implicit, with the forces of dampers taken at its end: the body of a function in
// dynamics.py, after lanes.cu. DAMPED is a constant, p, world and lane its arguments.

#if defined(__CUDA_ARCH__)
__shared__ float M[DAMPED ? NV * N : 1], v[NV];
#else
static float M[DAMPED ? NV * N : 1], v[NV];
#endif

const float h = p.timestep.data[0];
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
for (int s = 0; s < OWN; ++s) {
    const int j = lane + s * LANES;
    if (j >= NV) continue;
    row_of(p.qvel)[j] = v[j] = row_of(p.qvel)[j] + h * change[s];
    row_of(p.qacc_warmstart)[j] = qacc[j];
}
sync();

float* qpos = row_of(p.qpos);
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
    p.time.data[world] += h;
    if (p.nefc.data[world] > p.rows) p.overflow.data[world] |= NO_NEFC;
    if (p.ncollision.data[0] > p.contacts) p.overflow.data[world] |= NO_BROADPHASE;
    if (p.nacon.data[0] > p.contacts) p.overflow.data[world] |= NO_NARROWPHASE;
}
