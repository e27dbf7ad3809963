// What the lanes of a world share, for newton.cu and advance.cu. NV, LANES and WORLDS (of a block) are
// constants, world and thread arguments. The lanes work together: each has a degree of freedom, or none
// and then zeros. On a GPU they are a warp or a part of one, on a CPU there is one, or in tests several
// that take turns.

const int lane = thread % LANES, place_in_block = thread / LANES;
#if defined(__CUDA_ARCH__)
const unsigned mates = (LANES == 32 ? ~0u : (1u << LANES % 32) - 1u) << place_in_block * LANES;
auto sync = [=] { __syncwarp(mates); };
auto from = [=](int other, float a) { return __shfl_sync(mates, a, other, LANES); };
auto plus = [](float a, float b) { return __fadd_rn(a, b); };  // not fused: all lanes find the same
#else
static float mail[LANES];
auto sync = [] { WP_TILE_SYNC(); };
auto from = [&](int other, float a) {
    if (LANES == 1) return a;
    sync();
    mail[lane] = a;
    sync();
    return mail[other];
};
auto plus = [](float a, float b) { return a + b; };
#endif
auto sum = [&](float a) {
    #pragma unroll
    for (int k = LANES / 2; k > 0; k /= 2) a = plus(a, from(lane ^ k, a));
    return a;
};

constexpr int OWN = (NV + LANES - 1) / LANES;  // degrees of freedom of a lane
constexpr int N = (NV + 3) / 4 * 4;  // columns of a matrix, those beyond NV are 0

auto at_row = [](const auto& a, int row) {
    return (decltype(a.data))((char*)a.data + (size_t)row * a.strides[0]);
};
auto row_of = [&](const auto& a) { return at_row(a, world); };  // of this world

// H d = b by elimination, b in d [OWN]. H [OWN][N], a column a lane, is positive definite, needs no pivots
auto eliminate = [&](auto& H, auto& d) {
    auto entry = [&](int row, int i) { return from(row % LANES, H[row / LANES][i]); };
    auto of = [&](const float* a, int row) { return from(row % LANES, a[row / LANES]); };
    float pivot[NV];  // their inverses
    #pragma unroll
    for (int k = 0; k < NV; ++k) {
        pivot[k] = 1.0f / entry(k, k);
        float factor[OWN];
        for (int s = 0; s < OWN; ++s) {
            const int row = lane + s * LANES;
            factor[s] = row > k && row < NV ? H[s][k] * pivot[k] : 0.0f;
        }
        #pragma unroll
        for (int i = k + 1; i < NV; ++i) {
            const float above = entry(k, i);
            for (int s = 0; s < OWN; ++s) H[s][i] -= factor[s] * above;
        }
        const float above = of(d, k);
        for (int s = 0; s < OWN; ++s) d[s] -= factor[s] * above;
    }
    #pragma unroll
    for (int k = NV - 1; k >= 0; --k) {
        const float last = of(d, k) * pivot[k];
        for (int s = 0; s < OWN; ++s) {
            if (lane + s * LANES == k) d[s] = last;
            if (lane + s * LANES < k) d[s] -= H[s][k] * last;
        }
    }
};
