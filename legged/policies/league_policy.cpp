// Entry of $name in the G1 walking league, written by `legged export --format league`.
namespace $name {

constexpr int INPUTS = $inputs, STATE = $state, OWNED = $owned, THREADS = 128;
const float KP[] = {$kp};  // by motor
const float KD[] = {$kd};

// Copies `part` (robots, width) to the columns of `rows` (robots, length) that begin with `column`.
__global__ void paste(const float* part, int width, float* rows, int length, int column, int robots) {
  const int robot = blockIdx.x * blockDim.x + threadIdx.x;
  if (robot >= robots) return;
  for (int k = 0; k < width; ++k) rows[size_t(robot) * length + column + k] = part[size_t(robot) * width + k];
}

struct Policy : policy_api::Policy {
  // Scales, histories and last actions are in the network, which gives joint targets [rad].
  void init(int robots) override {
    robots_ = robots;
    network_ = policy_api::engine_make("policies/$name/model.onnx", robots,
                                       {{"obs", {-1, INPUTS}}, {"state_in", {1, -1, STATE}}},
                                       {{"actions", {-1, OWNED}}, {"state_out", {1, -1, STATE}}});
    for (auto [array, width] : {std::pair(&inputs_, INPUTS), {&targets_, OWNED}, {&state_, STATE}, {&next_, STATE}}) {
      cudaMalloc(array, size_t(robots) * width * sizeof(float));
      cudaMemset(*array, 0, size_t(robots) * width * sizeof(float));
    }
  }

  void step(const policy_api::Ctx& c) override {
    const int blocks = (robots_ + THREADS - 1) / THREADS;
    $pastes
    const float* in[] = {inputs_, state_};
    float* out[] = {targets_, next_};
    policy_api::engine_run(*network_, in, out, robots_);
    std::swap(state_, next_);
    paste<<<blocks, THREADS>>>(c.arm_pose, POLICY_NUM_MOTOR, c.q_target, POLICY_NUM_MOTOR, 0, robots_);
    paste<<<blocks, THREADS>>>(targets_, OWNED, c.q_target, POLICY_NUM_MOTOR, 0, robots_);
  }

  ~Policy() override {
    for (float* array : {inputs_, targets_, state_, next_}) cudaFree(array);
  }
  const float* kp() const override { return KP; }
  const float* kd() const override { return KD; }
  int owned() const override { return OWNED; }
  policy_api::Limits limits() const override { return {$limits, 0.0}; }
  const char* name() const override { return "$name"; }

  std::shared_ptr<policy_api::Engine> network_;
  float *inputs_ = nullptr, *targets_ = nullptr, *state_ = nullptr, *next_ = nullptr;
  int robots_ = 0;
};

}  // namespace $name
