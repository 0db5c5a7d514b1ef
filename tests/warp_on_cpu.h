// A warp of a GPU on one thread of the CPU, for the half of the native sources that is meant for GPUs: 32 lanes take turns,
// each running on to where all must meet. A lane that ends, or meets elsewhere, while others wait is an error.
#include <ucontext.h>

#include <cmath>
#include <vector>

#define __CUDA_ARCH__ 900
#define __shared__ static

struct { unsigned x; } threadIdx;

namespace warp_on_cpu {
enum { LANE_COUNT = 32, STACK_BYTES = 1 << 18 };
enum Place { NOWHERE, ENDED, SYNC, SHUFFLE };
ucontext_t scheduler, lanes[LANE_COUNT];
Place places[LANE_COUNT];
float shown[LANE_COUNT];
void (*body)(void*);
void* argument;

void run_lane() {
    body(argument);
    places[threadIdx.x] = ENDED;
    swapcontext(&lanes[threadIdx.x], &scheduler);
}

void wait_at(Place place) {
    const unsigned lane = threadIdx.x;
    places[lane] = place;
    swapcontext(&lanes[lane], &scheduler);
}

// Runs `function` on all lanes, the last lane first if `backwards`; returns whether they always met.
bool run(void (*function)(void*), void* with, bool backwards) {
    std::vector<char> stacks(LANE_COUNT * STACK_BYTES);
    body = function;
    argument = with;
    for (int i = 0; i < LANE_COUNT; ++i) {
        places[i] = NOWHERE;
        getcontext(&lanes[i]);
        lanes[i].uc_stack.ss_sp = &stacks[i * STACK_BYTES];
        lanes[i].uc_stack.ss_size = STACK_BYTES;
        makecontext(&lanes[i], run_lane, 0);
    }
    while (true) {
        for (int k = 0; k < LANE_COUNT; ++k) {
            threadIdx.x = backwards ? LANE_COUNT - 1 - k : k;
            swapcontext(&scheduler, &lanes[threadIdx.x]);
        }
        for (int i = 1; i < LANE_COUNT; ++i)
            if (places[i] != places[0]) return false;
        if (places[0] == ENDED) return true;
    }
}
}  // namespace warp_on_cpu

inline void __syncwarp() { warp_on_cpu::wait_at(warp_on_cpu::SYNC); }

inline float __shfl_sync(unsigned, float value, int from) {
    warp_on_cpu::shown[threadIdx.x] = value;
    warp_on_cpu::wait_at(warp_on_cpu::SHUFFLE);
    const float found = warp_on_cpu::shown[from & 31];
    warp_on_cpu::wait_at(warp_on_cpu::SHUFFLE);
    return found;
}

inline float __shfl_xor_sync(unsigned mask, float value, int apart) {
    return __shfl_sync(mask, value, (int)threadIdx.x ^ apart);
}

inline unsigned __ballot_sync(unsigned, bool on) {
    warp_on_cpu::shown[threadIdx.x] = on;
    warp_on_cpu::wait_at(warp_on_cpu::SHUFFLE);
    unsigned which = 0;
    for (unsigned i = 0; i < warp_on_cpu::LANE_COUNT; ++i) which |= (warp_on_cpu::shown[i] != 0.0f) << i;
    warp_on_cpu::wait_at(warp_on_cpu::SHUFFLE);
    return which;
}

inline int __any_sync(unsigned mask, bool on) { return __ballot_sync(mask, on) != 0; }
inline int __popc(unsigned x) { return __builtin_popcount(x); }
inline float rsqrtf(float x) { return 1.0f / sqrtf(x); }
