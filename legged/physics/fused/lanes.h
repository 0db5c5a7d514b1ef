// Code that all native sources share. On a GPU a warp of 32 threads ("lanes") computes a world; on the CPU one thread does.
//
// `native_source` (native.py) makes the body of a function from constants, this file and other files, in this order. A macro
// has the same meaning in all files, so none is ever undefined.

#if defined(__CUDA_ARCH__)
// Memory that all lanes of a world share.
#define LEGGED_SHARED alignas(16) __shared__
const int LANES = 32, lane = threadIdx.x & 31;
// Makes all lanes wait for each other, between writing shared memory and reading it.
[[maybe_unused]] auto meet = []() { __syncwarp(); };
// Returns the sum of x over all lanes, bit-identical in each.
[[maybe_unused]] auto sum = [](float x) {
    for (int apart = 16; apart > 0; apart >>= 1) x += __shfl_xor_sync(0xffffffffu, x, apart);
    return x;
};
// Computes the sums of four numbers over all lanes. In each of the first two exchanges, a lane gives half of its numbers to
// another lane.
[[maybe_unused]] auto sum_four = [&](float* x) {
    const bool upper = lane & 16, odd = lane & 8;
    for (int k = 0; k < 2; ++k) {
        const float given = __shfl_xor_sync(0xffffffffu, upper ? x[k] : x[2 + k], 16);
        x[k] = (upper ? x[2 + k] : x[k]) + given;
    }
    float one = (odd ? x[1] : x[0]) + __shfl_xor_sync(0xffffffffu, odd ? x[0] : x[1], 8);
    for (int apart = 4; apart > 0; apart >>= 1) one += __shfl_xor_sync(0xffffffffu, one, apart);
    for (int k = 0; k < 4; ++k) x[k] = __shfl_sync(0xffffffffu, one, 8 * k);
};
// Returns true if x is true in any lane.
[[maybe_unused]] auto any = [](bool x) { return __any_sync(0xffffffffu, x) != 0; };
// Appends all lanes that are `on` to a list of length `count`. Updates `count`, and returns this lane's place.
[[maybe_unused]] auto rank = [&](bool on, int& count) {
    const unsigned which = __ballot_sync(0xffffffffu, on);
    const int place = count + __popc(which & ((1u << lane) - 1u));
    count += __popc(which);
    return place;
};
// Returns 1 / x for a normal number; only the last bit may be wrong.
[[maybe_unused]] auto inverse = [](float x) {
#if defined(__CUDACC__)
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
#else
    return 1.0f / x;
#endif
};
#define UNROLLED _Pragma("unroll")
#define BY_TWO _Pragma("unroll 2")
#define BY_FOUR _Pragma("unroll 4")
#define ROLLED _Pragma("unroll 1")
// Returns the sum of x over the lanes before this one.
[[maybe_unused]] auto before = [&](float x) {
    float total = x;
    for (int apart = 1; apart < 32; apart <<= 1) {
        const float other = __shfl_sync(0xffffffffu, total, lane < apart ? lane : lane - apart);
        if (lane >= apart) total += other;
    }
    return total - x;
};
#else
#define LEGGED_SHARED
const int LANES = 1, lane = 0;
[[maybe_unused]] auto meet = []() {};
[[maybe_unused]] auto sum = [](float x) { return x; };
[[maybe_unused]] auto sum_four = [](float*) {};
[[maybe_unused]] auto any = [](bool x) { return x; };
[[maybe_unused]] auto rank = [](bool on, int& count) { return on ? count++ : count; };
[[maybe_unused]] auto inverse = [](float x) { return 1.0f / x; };
#define UNROLLED
#define BY_TWO
#define BY_FOUR
#define ROLLED
[[maybe_unused]] auto before = [](float) { return 0.0f; };
#endif
// Distributes `count` items over the lanes.
#define EACH(i, count) for (int i = lane; i < (count); i += LANES)

[[maybe_unused]] auto most = [](float p, float q) { return p > q ? p : q; };

// Vectors are three numbers; quaternions are (w, x, y, z).
[[maybe_unused]] auto cross = [](const float* u, const float* v, float* out) {
    out[0] = u[1] * v[2] - u[2] * v[1];
    out[1] = u[2] * v[0] - u[0] * v[2];
    out[2] = u[0] * v[1] - u[1] * v[0];
};
[[maybe_unused]] auto rotate = [&](const float* q, const float* v, float* out) {
    float t[3], tt[3];
    cross(q + 1, v, t);
    for (int k = 0; k < 3; ++k) t[k] *= 2.0f;
    cross(q + 1, t, tt);
    for (int k = 0; k < 3; ++k) out[k] = v[k] + q[0] * t[k] + tt[k];
};
[[maybe_unused]] auto multiply = [&](const float* p, const float* q, float* out) {
    float c[3];
    cross(p + 1, q + 1, c);
    out[0] = p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3];
    for (int k = 0; k < 3; ++k) out[1 + k] = p[0] * q[1 + k] + q[0] * p[1 + k] + c[k];
};
[[maybe_unused]] auto normalize = [](float* q) {
    const float length = sqrtf(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
    if (length < 1e-15f) { q[0] = 1.0f; q[1] = q[2] = q[3] = 0.0f; return; }
    for (int k = 0; k < 4; ++k) q[k] /= length;
};
[[maybe_unused]] auto to_matrix = [](const float* q, float* out) {
    const float xx = q[1] * q[1], yy = q[2] * q[2], zz = q[3] * q[3];
    const float xy = q[1] * q[2], xz = q[1] * q[3], yz = q[2] * q[3];
    const float wx = q[0] * q[1], wy = q[0] * q[2], wz = q[0] * q[3];
    out[0] = 1.0f - 2.0f * (yy + zz); out[1] = 2.0f * (xy - wz); out[2] = 2.0f * (xz + wy);
    out[3] = 2.0f * (xy + wz); out[4] = 1.0f - 2.0f * (xx + zz); out[5] = 2.0f * (yz - wx);
    out[6] = 2.0f * (xz - wy); out[7] = 2.0f * (yz + wx); out[8] = 1.0f - 2.0f * (xx + yy);
};
