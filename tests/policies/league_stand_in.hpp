// What an entry of the G1 walking league needs, on the CPU: arrays are plain memory, a kernel runs thread by thread, and the
// network is a function of the test. The test writes launches as calls of `launch`.
#include <cstdlib>
#include <cstring>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#define __global__

struct Index {
    unsigned x = 0;
};
static Index blockIdx, blockDim, threadIdx;

template <class Kernel, class... Given>
void launch(unsigned blocks, unsigned threads, Kernel kernel, Given... given) {
    blockDim.x = threads;
    for (blockIdx.x = 0; blockIdx.x < blocks; ++blockIdx.x)
        for (threadIdx.x = 0; threadIdx.x < threads; ++threadIdx.x) kernel(given...);
}

inline int cudaMalloc(float** array, size_t bytes) {
    *array = static_cast<float*>(std::malloc(bytes));
    std::memset(*array, 0xff, bytes);  // NaN: nothing may rely on zeros
    return 0;
}
inline int cudaMemset(void* array, int value, size_t bytes) { return std::memset(array, value, bytes) == nullptr; }
inline int cudaFree(void* array) {
    std::free(array);
    return 0;
}

namespace policy_api {

struct Limits {
    double vx_min, vx_max, vy_abs, yaw_rate_abs, speed_norm, reached = 0.1;
};
struct Ctx {
    const float *motor_q, *motor_dq, *gyro, *base_lin_vel, *gravity, *cmd, *task, *arm_pose, *base_quat;
    float* q_target;
};
struct Policy {
    virtual ~Policy() = default;
    virtual void init(int robots) = 0;
    virtual void step(const Ctx&) = 0;
    virtual const float* kp() const = 0;
    virtual const float* kd() const = 0;
    virtual int owned() const = 0;
    virtual Limits limits() const = 0;
    virtual const char* name() const = 0;
};
struct TensorSpec {
    std::string name;
    std::vector<int> shape;
};
struct Engine {
    std::string said;
};
using Specs = std::vector<TensorSpec>;
using Network = void (*)(const float* obs, const float* state, float* actions, float* next, int robots);
static Network network;

inline std::shared_ptr<Engine> engine_make(const std::string&, int, int, int) { return nullptr; }
inline std::shared_ptr<Engine> engine_make(const std::string& path, int, const Specs& inputs, const Specs& outputs) {
    auto engine = std::make_shared<Engine>(Engine{path});
    for (const Specs* specs : {&inputs, &outputs})
        for (const TensorSpec& spec : *specs) {
            engine->said += " " + spec.name;
            for (int size : spec.shape) engine->said += "," + std::to_string(size);
        }
    return engine;
}
inline void engine_run(Engine&, const float* const* in, float* const* out, int robots) {
    network(in[0], in[1], out[0], out[1], robots);
}

}  // namespace policy_api

constexpr int POLICY_NUM_MOTOR = 29;
