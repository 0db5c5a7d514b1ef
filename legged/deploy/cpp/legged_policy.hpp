// Runs a policy.weights file that play.py has exported. legged/deploy/weights.py describes its format.
//
//   legged::Policy policy("policy.weights");
//   std::vector<float> observation(policy.inputs()), actions(policy.outputs());
//   policy.run(observation.data(), actions.data());   // once every control_dt of policy.json
//   policy.restart();                                 // at the start of an episode: clears the hidden state
//
// Needs C++14 and a little-endian computer, but no other library. run() allocates no memory. policy.json describes the
// observation and the actions.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <stdexcept>
#include <string>
#include <vector>

namespace legged {

class Policy {
public:
    // Throws std::runtime_error if the file cannot be read or is not a weights file.
    explicit Policy(const std::string& path) {
        std::ifstream file(path, std::ios::binary);
        if (!file) throw std::runtime_error(path + ": cannot be read");
        char magic[8];
        read(file, path, magic, sizeof magic);
        if (std::memcmp(magic, "LEGGEDW1", sizeof magic) != 0) throw std::runtime_error(path + ": is no policy.weights");
        std::uint32_t count = 0;
        read(file, path, &count, sizeof count);
        std::size_t kept = 0;  // number of values that the next JOIN layer gets
        for (std::uint32_t i = 0; i < count; ++i) {
            std::uint32_t head[4];
            read(file, path, head, sizeof head);
            Layer layer;
            layer.kind = head[0];
            layer.detail = head[1];
            layer.inputs = head[2];
            layer.outputs = head[3];
            if (layer.kind > join || layer.inputs > largest || layer.outputs > largest)
                throw std::runtime_error(path + ": has a layer that this program does not know");
            if (layer.kind == activation && layer.detail >= activations)
                throw std::runtime_error(path + ": has a layer that this program does not know");
            if ((layer.kind == activation || layer.kind == normalise || layer.kind == keep) && layer.inputs != layer.outputs)
                throw std::runtime_error(path + ": has a layer whose outputs must be as many as its inputs");
            if (layer.kind == keep) kept = layer.inputs;
            if (layer.kind == join) {
                if (kept == 0 || layer.outputs != kept + layer.inputs)
                    throw std::runtime_error(path + ": has a layer JOIN without a layer KEEP that fits");
                kept = 0;
            }
            if (kept_.size() < kept) kept_.resize(kept);
            if (!layers_.empty() && layer.inputs != layers_.back().outputs)
                throw std::runtime_error(path + ": has layers that do not fit together");
            layer.numbers.resize(layer.size());
            read(file, path, layer.numbers.data(), sizeof(float) * layer.numbers.size());
            for (const float number : layer.numbers)
                if (!std::isfinite(number)) throw std::runtime_error(path + ": has numbers that are not finite");
            if (layer.kind == lstm || layer.kind == gru) {
                layer.hidden.assign(layer.outputs, 0.0f);
                layer.cell.assign(layer.outputs, 0.0f);
                gates_.resize(std::max<std::size_t>(gates_.size(), 8 * layer.outputs));
            }
            const std::size_t width = std::max(layer.inputs, layer.outputs);
            if (x_.size() < width) x_.resize(width), y_.resize(width);
            layers_.push_back(layer);
        }
        if (file.peek() != std::ifstream::traits_type::eof()) throw std::runtime_error(path + ": is longer than its layers");
        if (layers_.empty()) throw std::runtime_error(path + ": has no layers");
    }

    std::size_t inputs() const { return layers_.front().inputs; }
    std::size_t outputs() const { return layers_.back().outputs; }

    // Clears the hidden state of a recurrent policy.
    void restart() {
        for (Layer& layer : layers_) {
            std::fill(layer.hidden.begin(), layer.hidden.end(), 0.0f);
            std::fill(layer.cell.begin(), layer.cell.end(), 0.0f);
        }
    }

    // Computes outputs() actions from inputs() numbers of an observation.
    void run(const float* observation, float* actions) {
        std::copy(observation, observation + inputs(), x_.begin());
        for (Layer& layer : layers_) {
            const float* a = layer.numbers.data();
            const std::size_t m = layer.inputs, n = layer.outputs;
            if (layer.kind == normalise) {
                for (std::size_t i = 0; i < n; ++i) x_[i] = (x_[i] - a[i]) / a[n + i];
            } else if (layer.kind == linear) {
                multiply(a, a + n * m, x_.data(), m, n, y_.data());
                x_.swap(y_);
            } else if (layer.kind == activation) {
                for (std::size_t i = 0; i < n; ++i) x_[i] = static_cast<float>(activate(layer.detail, x_[i]));
            } else if (layer.kind == keep) {
                std::copy(x_.begin(), x_.begin() + n, kept_.begin());
            } else if (layer.kind == join) {
                std::copy_backward(x_.begin(), x_.begin() + m, x_.begin() + n);
                std::copy(kept_.begin(), kept_.begin() + (n - m), x_.begin());
            } else {
                advance(layer);
                std::copy(layer.hidden.begin(), layer.hidden.end(), x_.begin());
            }
        }
        std::copy(x_.begin(), x_.begin() + outputs(), actions);
    }

private:
    enum Kind : std::uint32_t { normalise, linear, activation, lstm, gru, keep, join };
    static constexpr std::uint32_t largest = 1u << 14, activations = 10;

    struct Layer {
        std::uint32_t kind, detail;
        std::size_t inputs, outputs;
        std::vector<float> numbers, hidden, cell;

        std::size_t size() const {
            const std::size_t rows = (kind == lstm ? 4 : 3) * outputs;
            if (kind == normalise) return 2 * inputs;
            if (kind == linear) return outputs * (inputs + 1);
            return kind == lstm || kind == gru ? rows * (inputs + outputs + 2) : 0;
        }
    };

    static void read(std::ifstream& file, const std::string& path, void* to, std::size_t bytes) {
        if (!file.read(static_cast<char*>(to), static_cast<std::streamsize>(bytes)))
            throw std::runtime_error(path + ": is cut short");
    }

    // y (n) = matrix (n, m) x (m) + bias (n), summed in double precision.
    static void multiply(const float* matrix, const float* bias, const float* x, std::size_t m, std::size_t n, float* y) {
        for (std::size_t i = 0; i < n; ++i, matrix += m) {
            double sum = bias[i];
            for (std::size_t j = 0; j < m; ++j) sum += static_cast<double>(matrix[j]) * x[j];
            y[i] = static_cast<float>(sum);
        }
    }

    static double sigmoid(double x) { return 0.5 * (1.0 + std::tanh(0.5 * x)); }
    static double softplus(double x) { return x > 0.0 ? x + std::log1p(std::exp(-x)) : std::log1p(std::exp(x)); }

    // `which` is an index in ACTIVATIONS of weights.py.
    static double activate(std::uint32_t which, double x) {
        switch (which) {
            case 0: return x > 0.0 ? x : std::expm1(x);
            case 1: return 1.0507009873554805 * (x > 0.0 ? x : 1.6732632423543772 * std::expm1(x));
            case 2: return x < 0.0 ? 0.0 : x;  // NaN stays NaN
            case 3: return x > 0.0 ? x : 0.01 * x;
            case 4: return std::tanh(x);
            case 5: return sigmoid(x);
            case 6: return softplus(x);
            case 7: return 0.5 * x * (1.0 + std::erf(x * 0.7071067811865476));
            case 8: return x * sigmoid(x);
            case 9: return x * std::tanh(softplus(x));
            default: return std::nan("");
        }
    }

    // Computes one step of a recurrent layer. Its input is x_; the result is in layer.hidden.
    void advance(Layer& layer) {
        const std::size_t m = layer.inputs, n = layer.outputs, rows = (layer.kind == lstm ? 4 : 3) * n;
        const float* of_input = layer.numbers.data();
        const float* of_past = of_input + rows * m;
        const float* bias = of_past + rows * n;
        float* a = gates_.data();
        float* b = a + rows;
        multiply(of_input, bias, x_.data(), m, rows, a);
        multiply(of_past, bias + rows, layer.hidden.data(), n, rows, b);
        for (std::size_t i = 0; i < n; ++i) {
            if (layer.kind == lstm) {
                const double in = sigmoid(a[i] + b[i]), forget = sigmoid(a[n + i] + b[n + i]);
                const double out = sigmoid(a[3 * n + i] + b[3 * n + i]);
                const double cell = forget * layer.cell[i] + in * std::tanh(a[2 * n + i] + b[2 * n + i]);
                layer.cell[i] = static_cast<float>(cell);
                layer.hidden[i] = static_cast<float>(out * std::tanh(cell));
            } else {
                const double reset = sigmoid(a[i] + b[i]), update = sigmoid(a[n + i] + b[n + i]);
                const double fresh = std::tanh(a[2 * n + i] + reset * b[2 * n + i]);
                layer.hidden[i] = static_cast<float>((1.0 - update) * fresh + update * layer.hidden[i]);
            }
        }
    }

    std::vector<Layer> layers_;
    std::vector<float> x_, y_, gates_, kept_;
};

}  // namespace legged
