// A draw from a network for each row, 192 rows at a time: the body of a function in drawn.py, which says
// what is computed and how `weights` are ordered. INPUTS, WIDTH, OUTPUTS and INNER are its `Sizes`.
// `hidden_product` and `output_product` multiply 64 rows of 16 inputs with half the columns of a layer.
// `room` is shared memory of SLOTS slots of SLOT bytes.
//
// Three groups of four warps have 64 rows each. The tensor cores give thread 4 g + t of a warp the
// columns 8 j + 2 t and 8 j + 2 t + 1 of its rows g and g + 8, and they want inputs in the same places.
// So what one layer gives is what the next one takes, and no thread needs the numbers of another. A
// fourth group fetches the weights, which come in the order of their use, into a ring of slots that all
// others read.

#if defined(__CUDA_ARCH__)
constexpr int GROUPS = 3, ROWS = 64 * GROUPS;
// bytes of the weights that lead from 16 inputs to half of a layer's outputs
constexpr int HALF = 256 * WIDTH, LAST = 256 * OUTPUTS;
constexpr int HALVES = 2 * (INPUTS + INNER * WIDTH), TILES = HALVES + 2 * WIDTH;
constexpr int DEEP = INPUTS > WIDTH ? INPUTS : WIDTH;

const int models = weights.shape[1], rows = x.shape[2], columns = out.shape[3];
const int copies = x.shape[0], of_group = copies / weights.shape[0];
const int blocks = (rows + ROWS - 1) / ROWS, tasks = copies * models * blocks;
auto network_of = [&](int task) {
    return task / (models * blocks) / of_group * models + task / blocks % models;
};

char* ring = (char*)room.data.ptr;
__shared__ unsigned long long full[SLOTS], empty[SLOTS];
auto at = [](const void* shared) { return (unsigned)__cvta_generic_to_shared(shared); };
auto wait = [&](unsigned long long* barrier, int parity) {
    asm volatile(
        "{\n.reg .pred done;\n"
        "again: mbarrier.try_wait.parity.shared::cta.b64 done, [%0], %1;\n@!done bra again;\n}"
        :: "r"(at(barrier)), "r"(parity) : "memory");
};
if (thread == 0) {
    for (int s = 0; s < SLOTS; ++s) {
        asm volatile("mbarrier.init.shared::cta.b64 [%0], 1;" :: "r"(at(full + s)));
        asm volatile("mbarrier.init.shared::cta.b64 [%0], %1;" :: "r"(at(empty + s)), "n"(GROUPS));
    }
    asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
}
__syncthreads();

int slot = 0, turn = 0;
auto advance = [&] { if (++slot == SLOTS) slot = 0, turn ^= 1; };

// 384 x 160 + 128 x 24 = 64,512 of the 65,536 registers
if (thread >= 128 * GROUPS) {  // the group that fetches
    asm volatile("setmaxnreg.dec.sync.aligned.u32 24;");
    for (int task = block; thread == 128 * GROUPS && task < tasks; task += gridDim.x) {
        const char* from = (const char*)(weights.data + (long long)network_of(task) * weights.shape[2]);
        for (int i = 0; i < TILES; ++i, advance()) {
            const int bytes = i < HALVES ? HALF : LAST;
            wait(empty + slot, turn ^ 1);  // passes at once in the first turn
            asm volatile(
                "mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;"
                :: "r"(at(full + slot)), "r"(bytes));
            asm volatile(
                "cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes [%0], [%1], %2, [%3];"
                :: "r"(at(ring + slot * SLOT)), "l"(from), "r"(bytes), "r"(at(full + slot))
                : "memory");
            from += bytes;
        }
    }
} else {  // the groups that compute
    asm volatile("setmaxnreg.inc.sync.aligned.u32 160;");
    const int g = thread % 32 / 4, t = thread % 4;
    auto release = [&](int s) {
        if (thread % 128 == 0)
            asm volatile("mbarrier.arrive.shared::cta.b64 _, [%0];" :: "r"(at(empty + s)) : "memory");
    };
    // sum = a times half a layer of `deep` sixteens of inputs; `wide` numbers of it are this thread's
    auto half_layer = [&](auto product, float* sum, auto wide, unsigned (*a)[2], auto deep) {
        int before = 0;
        #pragma unroll
        for (int k = 0; k < deep.value; ++k) {
            wait(full + slot, turn);
            // blocks of 8 outputs x 8 inputs, 128 bytes each; those of the same outputs are neighbours
            const size_t where = at(ring + slot * SLOT) >> 4 | 8ull << 16 | 16ull << 32;
            asm volatile("wgmma.fence.sync.aligned;" ::: "memory");
            product(sum, a[2 * k][0], a[2 * k][1], a[2 * k + 1][0], a[2 * k + 1][1], where, k > 0);
            asm volatile("wgmma.commit_group.sync.aligned;" ::: "memory");
            if (k > 0) {
                asm volatile("wgmma.wait_group.sync.aligned 1;" ::: "memory");
                release(before);
            }
            before = slot;
            advance();
        }
        asm volatile("wgmma.wait_group.sync.aligned 0;" ::: "memory");
        #pragma unroll
        for (int i = 0; i < wide.value; ++i) asm volatile("" : "+f"(sum[i]) :: "memory");  // now it is read
        release(before);
    };
    auto swish = [](float z) {
        float tanh;
        asm("tanh.approx.f32 %0, %1;" : "=f"(tanh) : "f"(0.5f * z));
        return 0.5f * z * tanh + 0.5f * z;
    };
    auto active = [&](float low, float high) {  // swish of both, as bfloat16
        unsigned both;
        asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(both) : "f"(swish(high)), "f"(swish(low)));
        return both;
    };
    auto root = [](float z) {
        asm("sqrt.approx.f32 %0, %0;" : "+f"(z));
        return z;
    };
    struct In { enum { value = INPUTS }; };
    struct Hidden { enum { value = WIDTH }; };
    struct HiddenSums { enum { value = 4 * WIDTH }; };
    struct OutputSums { enum { value = 4 * OUTPUTS }; };

    unsigned now[2 * DEEP][2], next[WIDTH][2];  // what the layer takes; what its first half gives
    auto layer = [&](auto deep) {
        float sum[4 * WIDTH];
        #pragma unroll
        for (int side = 0; side < 2; ++side) {
            half_layer(hidden_product, sum, HiddenSums(), now, deep);
            #pragma unroll
            for (int j = 0; j < WIDTH; ++j) {
                unsigned* to = side ? now[WIDTH + j] : next[j];
                to[0] = active(sum[4 * j], sum[4 * j + 1]);
                to[1] = active(sum[4 * j + 2], sum[4 * j + 3]);
            }
        }
        #pragma unroll
        for (int j = 0; j < WIDTH; ++j) now[j][0] = next[j][0], now[j][1] = next[j][1];
    };

    for (int task = block; task < tasks; task += gridDim.x) {
        const int top = task % blocks * ROWS + thread / 32 * 16 + g;  // and its other row, 8 below
        const long long slab = (long long)(task / blocks) * rows;
        const unsigned* x_words = (const unsigned*)x.data + t;
        const unsigned* upper = x_words + (slab + wp::min(top, rows - 1)) * 8 * INPUTS;
        const unsigned* lower = x_words + (slab + wp::min(top + 8, rows - 1)) * 8 * INPUTS;
        #pragma unroll
        for (int j = 0; j < 2 * INPUTS; ++j) now[j][0] = upper[4 * j], now[j][1] = lower[4 * j];
        layer(In());
        #pragma unroll 1
        for (int i = 0; i < INNER; ++i) layer(Hidden());

        float mean[4 * OUTPUTS], raw[4 * OUTPUTS];
        half_layer(output_product, mean, OutputSums(), now, Hidden());
        half_layer(output_product, raw, OutputSums(), now, Hidden());

        const unsigned* key = seed.data + task / (models * blocks) * 2;
        const float2* least = (const float2*)(bounds.data + (long long)network_of(task) * 2 * columns);
        float length[2] = {0.0f, 0.0f};  // of the standard deviations of each row, squared
        #pragma unroll
        for (int j = 0; j < OUTPUTS; ++j) {
            const int column = 8 * j + 2 * t;
            if (column >= columns) continue;
            const float2 low = __ldg(least + column / 2), high = __ldg(least + (columns + column) / 2);
            unsigned bits[4] = {(unsigned)top, (unsigned)column, (unsigned)(task / blocks % models), 0u};
            unsigned key0 = __ldg(key), key1 = __ldg(key + 1);
            #pragma unroll
            for (int round = 0; round < 7; ++round) {  // Philox 4 x 32
                const unsigned up = __umulhi(0xCD9E8D57u, bits[2]) ^ bits[1] ^ key0;
                const unsigned down = __umulhi(0xD2511F53u, bits[0]) ^ bits[3] ^ key1;
                bits[1] = 0xCD9E8D57u * bits[2], bits[3] = 0xD2511F53u * bits[0];
                bits[0] = up, bits[2] = down;
                key0 += 0x9E3779B9u, key1 += 0xBB67AE85u;
            }
            #pragma unroll
            for (int r = 0; r < 2; ++r) {  // Box and Muller
                const float *m = mean + 4 * j + 2 * r, *v = raw + 4 * j + 2 * r;
                float sine, cosine;
                __sincosf(1.4629181e-9f * bits[2 * r], &sine, &cosine);
                const float uniform = 2.3283064e-10f * bits[2 * r + 1] + 1.1641532e-10f;
                const float square = fmaxf(-2.0f * __logf(uniform), 0.0f);  // rounding may pass 0
                const float left = low.x + __fdividef(1.0f, high.x + __expf(-v[0]));
                const float right = low.y + __fdividef(1.0f, high.y + __expf(-v[1]));
                length[r] += left + right;
                const float2 drawn = make_float2(
                    m[0] + root(left * square) * sine, m[1] + root(right * square) * cosine);
                const long long row = slab + top + 8 * r;
                if (top + 8 * r < rows) *(float2*)(out.data + row * columns + column) = drawn;
            }
        }
        #pragma unroll
        for (int r = 0; r < 2; ++r) {
            length[r] += __shfl_xor_sync(0xFFFFFFFFu, length[r], 1);
            length[r] += __shfl_xor_sync(0xFFFFFFFFu, length[r], 2);
            if (t == 0 && top + 8 * r < rows) spread.data[slab + top + 8 * r] = root(length[r]);
        }
    }
}
#endif
