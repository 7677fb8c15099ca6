// T is the type of images between the convolutions.
#if BF16
typedef unsigned short T;
__device__ __forceinline__ float load(T v) { return __uint_as_float((unsigned)v << 16); }
__device__ __forceinline__ T store(float f) { T v; asm("cvt.rn.bf16.f32 %0, %1;" : "=h"(v) : "f"(f)); return v; }
#else  // on a CPU, for tests
typedef float T;
inline float load(T v) { return v; }
inline T store(float v) { return v; }
#endif

struct __align__(PACK * sizeof(T)) Pack { T v[PACK]; };

// All images are channels last: [height, width, channels]. A thread has one pack of channels of one pixel.

// The place of a thread: a pixel of an image of HIGH x WIDE pixels, and its first channel of the pack.
#define PLACE(HIGH, WIDE) \
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x; \
    const int packs = channels / PACK; \
    if (i >= (long long)(HIGH) * (WIDE) * packs) return; \
    const int c = (int)(i % packs) * PACK; \
    const long long place = i / packs; \
    const int column = (int)(place % (WIDE)), row = (int)(place / (WIDE));

__device__ __forceinline__ float leaky(float x) { return x > 0.0f ? x : SLOPE * x; }

__device__ __forceinline__ T activated(T x, float bias) { return store(leaky(load(x) + bias)); }

// Casts and concatenates splatted values, pads them by zeros at the bottom, to the right and in channels, and folds
// blocks of R x R pixels into channels: channel c of pixel (dy, dx) of a block becomes channel (c R + dy) R + dx.
extern "C" __global__ void fold(const float* __restrict__ splatted, int splatted_stride,
                                const float* __restrict__ alpha, int alpha_stride, int num_colors, int num_features,
                                int padded, int height, int width, int rows, int columns, T* __restrict__ out) {
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (i >= (long long)rows * columns * padded) return;
    const int c = (int)(i % padded);
    const long long block = i / padded;
    const int x = (int)(block % columns), y = (int)(block / columns);
    const bool is_alpha = c < num_colors && c == 3;
    const float* from = is_alpha ? alpha : splatted + (c < num_colors ? c : c - num_colors + 3);
    const int stride = is_alpha ? alpha_stride : splatted_stride;
    T* result = out + i * (R * R);
    for (int dy = 0; dy < R; ++dy)
        for (int dx = 0; dx < R; ++dx) {
            const int row = y * R + dy, column = x * R + dx;
            const bool inside = row < height && column < width && c < num_colors + num_features;
            result[dy * R + dx] = store(inside ? from[((long long)row * width + column) * stride] : 0.0f);
        }
}

// Adds the bias and activates, in place.
extern "C" __global__ void activate(T* x, const float* __restrict__ bias, int channels, int pixels) {
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    const int packs = channels / PACK;
    if (i >= (long long)pixels * packs) return;
    const int c = (int)(i % packs) * PACK;
    Pack pack = ((Pack*)x)[i];
#pragma unroll
    for (int k = 0; k < PACK; ++k) pack.v[k] = activated(pack.v[k], bias[c + k]);
    ((Pack*)x)[i] = pack;
}

// Adds the bias and activates; writes the result into the last channels of a wider image, and the mean of 2 x 2 pixels.
extern "C" __global__ void pool(const T* __restrict__ x, const float* __restrict__ bias, int channels, int rows,
                                int columns, T* __restrict__ wide, int wide_channels, T* __restrict__ pooled) {
    PLACE(rows / 2, columns / 2)
    float sum[PACK] = {};
    for (int dy = 0; dy < 2; ++dy)
        for (int dx = 0; dx < 2; ++dx) {
            const long long pixel = (long long)(2 * row + dy) * columns + 2 * column + dx;
            Pack pack = *(const Pack*)(x + pixel * channels + c);
#pragma unroll
            for (int k = 0; k < PACK; ++k) {
                pack.v[k] = activated(pack.v[k], bias[c + k]);
                sum[k] += load(pack.v[k]);
            }
            *(Pack*)(wide + pixel * wide_channels + (wide_channels - channels) + c) = pack;
        }
    Pack mean;
#pragma unroll
    for (int k = 0; k < PACK; ++k) mean.v[k] = store(0.25f * sum[k]);
    ((Pack*)pooled)[i] = mean;
}

// Adds the bias, activates, doubles the size bilinearly (pixels are areas), and writes into the first channels of a
// wider image. A fine pixel's centre is a quarter of a coarse pixel from the centre of its coarse pixel.
extern "C" __global__ void upsample(const T* __restrict__ x, const float* __restrict__ bias, int channels, int rows,
                                    int columns, T* __restrict__ wide, int wide_channels) {
    PLACE(2 * rows, 2 * columns)
    const int near_y = row / 2, far_y = near_y + (row % 2 ? 1 : -1);
    const int near_x = column / 2, far_x = near_x + (column % 2 ? 1 : -1);
    const int ys[2] = {near_y, far_y < 0 ? 0 : far_y >= rows ? rows - 1 : far_y};
    const int xs[2] = {near_x, far_x < 0 ? 0 : far_x >= columns ? columns - 1 : far_x};
    float sum[PACK] = {};
    for (int a = 0; a < 2; ++a)
        for (int b = 0; b < 2; ++b) {
            const float weight = (a ? 0.25f : 0.75f) * (b ? 0.25f : 0.75f);
            const Pack pack = *(const Pack*)(x + ((long long)ys[a] * columns + xs[b]) * channels + c);
#pragma unroll
            for (int k = 0; k < PACK; ++k) sum[k] += weight * load(activated(pack.v[k], bias[c + k]));
        }
    Pack pack;
#pragma unroll
    for (int k = 0; k < PACK; ++k) pack.v[k] = store(sum[k]);
    *(Pack*)(wide + place * wide_channels + c) = pack;
}

// Adds the bias, activates, applies the final 1 x 1 convolution, unfolds blocks, crops, and adds the correction.
extern "C" __global__ void unfold(const T* __restrict__ x, const float* __restrict__ bias,
                                  const float* __restrict__ weight, const float* __restrict__ out_bias, int rows,
                                  int columns, const float* __restrict__ base, const float* __restrict__ alpha,
                                  int alpha_stride, int height, int width, float* __restrict__ out) {
    __shared__ float w[3 * R * R * WIDTH];
    for (int k = threadIdx.x; k < 3 * R * R * WIDTH; k += blockDim.x) w[k] = weight[k];
    __syncthreads();
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (i >= (long long)rows * columns) return;
    float sum[3 * R * R];
#pragma unroll
    for (int o = 0; o < 3 * R * R; ++o) sum[o] = out_bias[o];
    for (int c = 0; c < WIDTH; c += PACK) {
        const Pack pack = *(const Pack*)(x + i * WIDTH + c);
#pragma unroll
        for (int k = 0; k < PACK; ++k) {
            const float value = load(activated(pack.v[k], bias[c + k]));
#pragma unroll
            for (int o = 0; o < 3 * R * R; ++o) sum[o] += w[o * WIDTH + c + k] * value;
        }
    }
    const int column = (int)(i % columns) * R, row = (int)(i / columns) * R;
#pragma unroll
    for (int o = 0; o < 3 * R * R; ++o) {
        const int c = o / (R * R), y = row + o / R % R, x = column + o % R;
        if (y >= height || x >= width) continue;
        const long long pixel = (long long)y * width + x;
        // Pixels that overflowed are not corrected.
        const float value = sum[o] - sum[o] == 0.0f ? sum[o] : 0.0f;
        out[3 * pixel + c] = RESIDUAL ? base[3 * pixel + c] + alpha[pixel * alpha_stride] * value : value;
    }
}

// Gradients. An activation keeps its input's sign, so its value determines its slope.

__device__ __forceinline__ float leaky_gradient(float gradient, float at) {
    return at > 0.0f ? gradient : SLOPE * gradient;
}

// Backward of `unfold`: the gradient of its input; and for the gradient of the 1 x 1 convolution's weights, its input
// activations and the gradients of its outputs.
extern "C" __global__ void unfold_backward(const T* __restrict__ x, const float* __restrict__ bias,
                                           const float* __restrict__ weight, const float* __restrict__ out_bias,
                                           int rows, int columns, const float* __restrict__ gradient,
                                           const float* __restrict__ alpha, int alpha_stride, int height, int width,
                                           T* __restrict__ grad_x, T* __restrict__ values, T* __restrict__ grad_values,
                                           float* __restrict__ grad_alpha) {
    __shared__ float w[3 * R * R * WIDTH];
    for (int k = threadIdx.x; k < 3 * R * R * WIDTH; k += blockDim.x) w[k] = weight[k];
    __syncthreads();
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (i >= (long long)rows * columns) return;
    const int column = (int)(i % columns) * R, row = (int)(i / columns) * R;
    float sum[3 * R * R], grad_sum[3 * R * R];
#pragma unroll
    for (int o = 0; o < 3 * R * R; ++o) {
        const int c = o / (R * R), y = row + o / R % R, x_ = column + o % R;
        const long long pixel = (long long)y * width + x_;
        const bool inside = y < height && x_ < width;
        sum[o] = out_bias[o];
        grad_sum[o] = inside ? gradient[3 * pixel + c] * (RESIDUAL ? alpha[pixel * alpha_stride] : 1.0f) : 0.0f;
        grad_values[i * (3 * R * R) + o] = store(grad_sum[o]);
    }
    for (int c = 0; c < WIDTH; c += PACK) {
        Pack pack = *(const Pack*)(x + i * WIDTH + c), result;
#pragma unroll
        for (int k = 0; k < PACK; ++k) {
            pack.v[k] = activated(pack.v[k], bias[c + k]);
            const float value = load(pack.v[k]);
            float total = 0.0f;
#pragma unroll
            for (int o = 0; o < 3 * R * R; ++o) {
                const float factor = w[o * WIDTH + c + k];
                sum[o] += factor * value;
                total += factor * grad_sum[o];
            }
            result.v[k] = store(leaky_gradient(total, value));
        }
        *(Pack*)(grad_x + i * WIDTH + c) = result;
        *(Pack*)(values + i * WIDTH + c) = pack;
    }
    if (!RESIDUAL) return;
    for (int dy = 0; dy < R; ++dy)
        for (int dx = 0; dx < R; ++dx) {
            const int y = row + dy, x_ = column + dx;
            if (y >= height || x_ >= width) continue;
            const long long pixel = (long long)y * width + x_;
            float total = 0.0f;
#pragma unroll
            for (int c = 0; c < 3; ++c) total += gradient[3 * pixel + c] * sum[(c * R + dy) * R + dx];
            grad_alpha[pixel] = total;
        }
}

// Backward of `activate`, in place.
extern "C" __global__ void activate_backward(T* gradient, const T* __restrict__ activations, int channels, int pixels) {
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (i >= (long long)pixels * (channels / PACK)) return;
    Pack pack = ((Pack*)gradient)[i];
    const Pack at = ((const Pack*)activations)[i];
#pragma unroll
    for (int k = 0; k < PACK; ++k) pack.v[k] = store(leaky_gradient(load(pack.v[k]), load(at.v[k])));
    ((Pack*)gradient)[i] = pack;
}

// Adds the sum over all pixels to each channel's current value. Threads must number at least `workers`.
extern "C" __global__ void sum_pixels(const T* __restrict__ x, int channels, int pixels, int workers,
                                      float* __restrict__ sums) {
    __shared__ float partial[MOST_CHANNELS];
    const int packs = channels / PACK, stride = workers / packs;
    const int thread = (int)(blockIdx.x * blockDim.x + threadIdx.x), c = thread % packs * PACK;
    for (int k = threadIdx.x; k < channels; k += blockDim.x) partial[k] = 0;
    __syncthreads();
    if (thread < stride * packs && thread / packs < pixels) {
        float sum[PACK] = {};
        for (int pixel = thread / packs; pixel < pixels; pixel += stride) {
            const Pack pack = *(const Pack*)(x + (long long)pixel * channels + c);
#pragma unroll
            for (int k = 0; k < PACK; ++k) sum[k] += load(pack.v[k]);
        }
#pragma unroll
        for (int k = 0; k < PACK; ++k) atomicAdd(partial + c + k, sum[k]);
    }
    __syncthreads();
    for (int k = threadIdx.x; k < channels; k += blockDim.x)
        if (partial[k] != 0) atomicAdd(sums + k, partial[k]);
}

// Backward of `pool`: the gradient of its input, from those of the skip connection and of the mean.
extern "C" __global__ void pool_backward(const T* __restrict__ grad_wide, const T* __restrict__ wide, int wide_channels,
                                         const T* __restrict__ grad_pooled, int channels, int rows, int columns,
                                         T* __restrict__ grad_x) {
    PLACE(rows, columns)
    const long long at = place * wide_channels + (wide_channels - channels) + c;
    const Pack direct = *(const Pack*)(grad_wide + at), activations = *(const Pack*)(wide + at);
    const long long coarse = (long long)(row / 2) * (columns / 2) + column / 2;
    const Pack mean = *(const Pack*)(grad_pooled + coarse * channels + c);
    Pack result;
#pragma unroll
    for (int k = 0; k < PACK; ++k)
        result.v[k] = store(leaky_gradient(load(direct.v[k]) + 0.25f * load(mean.v[k]), load(activations.v[k])));
    ((Pack*)grad_x)[i] = result;
}

// Backward of `upsample`: gathers with the same weights. At a border the last pixel stands for those beyond it.
extern "C" __global__ void upsample_backward(const T* __restrict__ grad_wide, int wide_channels,
                                             const T* __restrict__ x, const float* __restrict__ bias, int channels,
                                             int rows, int columns, T* __restrict__ grad_x) {
    PLACE(rows, columns)
    float sum[PACK] = {};
    for (int a = -1; a < 3; ++a)
        for (int b = -1; b < 3; ++b) {
            const int y = 2 * row + a, x_ = 2 * column + b;
            const int fine_y = y < 0 ? 0 : y >= 2 * rows ? 2 * rows - 1 : y;
            const int fine_x = x_ < 0 ? 0 : x_ >= 2 * columns ? 2 * columns - 1 : x_;
            const float weight = (a == 0 || a == 1 ? 0.75f : 0.25f) * (b == 0 || b == 1 ? 0.75f : 0.25f);
            const long long pixel = (long long)fine_y * 2 * columns + fine_x;
            const Pack pack = *(const Pack*)(grad_wide + pixel * wide_channels + c);
#pragma unroll
            for (int k = 0; k < PACK; ++k) sum[k] += weight * load(pack.v[k]);
        }
    const Pack pack = ((const Pack*)x)[i];
    Pack result;
#pragma unroll
    for (int k = 0; k < PACK; ++k) result.v[k] = store(leaky_gradient(sum[k], load(pack.v[k]) + bias[c + k]));
    ((Pack*)grad_x)[i] = result;
}

// Backward of `fold`; the gradient of accumulation is added to its current value.
extern "C" __global__ void fold_backward(const T* __restrict__ grad_folded, int num_colors, int num_features,
                                         int padded, int height, int width, int rows, int columns,
                                         float* __restrict__ grad_splatted, float* __restrict__ grad_alpha) {
    const long long i = blockIdx.x * (long long)blockDim.x + threadIdx.x;
    if (i >= (long long)rows * columns * padded) return;
    const int c = (int)(i % padded);
    if (c >= num_colors + num_features) return;
    const long long block = i / padded;
    const int x = (int)(block % columns), y = (int)(block / columns);
    const T* from = grad_folded + i * (R * R);
    for (int dy = 0; dy < R; ++dy)
        for (int dx = 0; dx < R; ++dx) {
            const int row = y * R + dy, column = x * R + dx;
            if (row >= height || column >= width) continue;
            const long long pixel = (long long)row * width + column;
            const float value = load(from[dy * R + dx]);
            if (c < num_colors && c == 3)
                grad_alpha[pixel] += value;
            else
                grad_splatted[pixel * (3 + num_features) + (c < num_colors ? c : c - num_colors + 3)] = value;
        }
}
