#include "box.cuh"

#define WIDE 8   // pixels of a warp
#define HIGH 4
#define ACROSS (TILE / WIDE)  // warps side by side
#define ALL 0xffffffffu

struct __align__(16) Shape {
    float x, y, opacity, a, b, c;  // the exponent is a dx^2 + 2 b dx dy + c dy^2
    int gaussian;
    unsigned warps;  // a bit for each warp with pixels that may blend the Gaussian
};

// A part of a tile's list, which the threads of a block read together.
struct Batch {
    Shape shapes[THREADS];
    __align__(16) float colors[THREADS][PADDED];
};

#define LISTS int width, int height, int tiles, int num_lists, int pairs, const int* __restrict__ starts, \
    const int* __restrict__ list
#define FIELD const float* __restrict__ means, const float* __restrict__ conics, const float* __restrict__ colors, \
    const float* __restrict__ opacities

__device__ __forceinline__ void read(Batch& batch, const int* __restrict__ list, int count, int tile, int width,
                                     FIELD) {
    const int columns = (width + TILE - 1) / TILE;
    for (int k = threadIdx.x; k < count; k += blockDim.x) {
        const long long i = list[k];
        Shape s = {means[2 * i], means[2 * i + 1], opacities[i], 0.5f * conics[3 * i],
                   0.5f * conics[3 * i + 1], 0.5f * conics[3 * i + 2], (int)i, 0};
        const float down = -s.b / s.c, across = -s.b / s.a, reach = logf(s.opacity * 255.0f);
        const float left = tile % columns * TILE + 0.5f - s.x, up = tile / columns * TILE + 0.5f - s.y;
#pragma unroll
        for (int warp = 0; warp < THREADS / (WIDE * HIGH); ++warp) {
            const float x = left + warp % ACROSS * WIDE, y = up + warp / ACROSS * HIGH;
            if (!misses_box(s.a, s.b, s.c, down, across, reach, x, x + WIDE - 1, y, y + HIGH - 1))
                s.warps |= 1u << warp;
        }
        batch.shapes[k] = s;
#pragma unroll
        for (int c = 0; c < CHANNELS; ++c) batch.colors[k][c] = colors[i * CHANNELS + c];
    }
}

struct Pixel {
    float x, y;
    long long at;  // in the image
    bool inside;
};

// Pixels of a warp form a block, because most Gaussians are as wide as high.
__device__ __forceinline__ Pixel pixel_of(int tile, int number, int width, int height) {
    const int columns = (width + TILE - 1) / TILE, warp = number / (WIDE * HIGH), place = number % (WIDE * HIGH);
    const int x = tile % columns * TILE + warp % ACROSS * WIDE + place % WIDE;
    const int y = tile / columns * TILE + warp / ACROSS * HIGH + place / WIDE;
    const Pixel pixel = {x + 0.5f, y + 0.5f, (long long)y * width + x, x < width && y < height};
    return pixel;
}

// Alpha before it is limited, or 0 where the Gaussian is too faint to be blended.
__device__ __forceinline__ float falloff(const Shape& s, float dx, float dy) {
    const float exponent = s.a * dx * dx + s.c * dy * dy + 2 * s.b * dx * dy;
    return exponent < 0 ? 0 : __expf(-exponent);
}

// One block blends one tile.
extern "C" __global__ void blend(LISTS, FIELD, float* __restrict__ image,
                                 float* __restrict__ alphas, float* __restrict__ transmittances,
                                 int* __restrict__ stops) {
    __shared__ Batch batch;
    const int tile = blockIdx.x;
    if (tile >= tiles) return;
    const int lane = threadIdx.x % LANES, begin = starts[tile], end = tile + 1 < num_lists ? starts[tile + 1] : pairs;
    for (int number = threadIdx.x; number < THREADS; number += blockDim.x) {  // once on a GPU
        const int warp = number / (WIDE * HIGH);
        const Pixel pixel = pixel_of(tile, number, width, height);
        float through = 1, sums[CHANNELS] = {};
        int stop = begin;
        bool done = !pixel.inside;
        for (int first = begin; first < end; first += THREADS) {
            if (__syncthreads_count(done) == blockDim.x) break;
            const int count = end - first < THREADS ? end - first : THREADS;
            read(batch, list + first, count, tile, width, means, conics, colors, opacities);
            __syncthreads();
            for (int some = 0; some < count && !__all_sync(ALL, done); some += LANES) {
                unsigned bits = __ballot_sync(ALL, some + lane < count && batch.shapes[some + lane].warps >> warp & 1);
                for (; bits != 0; bits &= bits - 1) {
                    if (done) continue;
                    const int k = some + __ffs(bits) - 1;
                    const Shape s = batch.shapes[k];
                    const float alpha = fminf(MAX_ALPHA, s.opacity * falloff(s, s.x - pixel.x, s.y - pixel.y));
                    if (alpha < MIN_ALPHA) continue;
                    const float behind = through * (1 - alpha);
                    done = behind <= MIN_TRANSMITTANCE;
                    if (done) continue;
                    const float weight = alpha * through;
#pragma unroll
                    for (int c = 0; c < CHANNELS; ++c) sums[c] += weight * batch.colors[k][c];
                    stop = first + k + 1;
                    through = behind;
                }
            }
        }
        if (!pixel.inside) continue;
#pragma unroll
        for (int c = 0; c < CHANNELS; ++c) image[pixel.at * CHANNELS + c] = sums[c];
        alphas[pixel.at] = 1 - through;
        transmittances[pixel.at] = through;
        stops[pixel.at] = stop;
    }
}

// Sums of each value over the lanes of a warp. Lanes exchange and keep half of the values as long as there are two;
// afterwards lane l holds the sums from l * SLOTS / LANES on.
template <int OFFSET, int HAVE>
__device__ __forceinline__ void sum_over_lanes(float* values, int lane) {
    if constexpr (OFFSET > 0) {
        if constexpr (HAVE > 1) {
            const bool upper = lane & OFFSET;
#pragma unroll
            for (int k = 0; k < HAVE / 2; ++k) {
                const float mine = upper ? values[k + HAVE / 2] : values[k];
                const float other = upper ? values[k] : values[k + HAVE / 2];
                values[k] = mine + __shfl_xor_sync(ALL, other, OFFSET);
            }
        } else {
            values[0] += __shfl_xor_sync(ALL, values[0], OFFSET);
        }
        sum_over_lanes<OFFSET / 2, (HAVE > 1 ? HAVE / 2 : 1)>(values, lane);
    }
}

#define KEPT (SLOTS > LANES ? SLOTS / LANES : 1)     // sums that a lane holds at the end
#define SHARERS (LANES > SLOTS ? LANES / SLOTS : 1)  // lanes that hold the same sum

// One block goes through one tile from back to front. Gradients are added to their current values.
extern "C" __global__ void blend_backward(LISTS, FIELD, const float* __restrict__ transmittances,
                                          const int* __restrict__ stops, const float* __restrict__ grad_image,
                                          const float* __restrict__ grad_alphas, float* __restrict__ grad_means,
                                          float* __restrict__ grad_conics, float* __restrict__ grad_colors,
                                          float* __restrict__ grad_opacities, float* __restrict__ grad_absolute) {
    __shared__ Batch batch;
    __shared__ int most;
    const int tile = blockIdx.x;
    if (tile >= tiles) return;
    const int begin = starts[tile];
    const int lane = threadIdx.x % LANES;

    // Where this lane adds its sums: colours, centre, conic, opacity, absolute gradient of the centre.
    float* into[KEPT];
    int stride[KEPT];
#pragma unroll
    for (int k = 0; k < KEPT; ++k) {
        const int value = lane / SHARERS * KEPT + k, shape = value - CHANNELS;
        into[k] = 0;
        if (lane % SHARERS != 0 || value >= VALUES) continue;
        into[k] = value < CHANNELS ? grad_colors + value
                  : shape < 2      ? grad_means + shape
                  : shape < 5      ? grad_conics + shape - 2
                  : shape < 6      ? grad_opacities
                                   : grad_absolute + shape - 6;
        stride[k] = value < CHANNELS ? CHANNELS : shape < 2 ? 2 : shape < 5 ? 3 : shape < 6 ? 1 : 2;
    }

    for (int number = threadIdx.x; number < THREADS; number += blockDim.x) {  // once on a GPU
        const int warp = number / (WIDE * HIGH);
        const Pixel pixel = pixel_of(tile, number, width, height);
        const int stop = pixel.inside ? stops[pixel.at] : begin;
        int end_of_warp = stop;
#pragma unroll
        for (int offset = LANES / 2; offset > 0; offset /= 2) {
            const int other = __shfl_xor_sync(ALL, end_of_warp, offset);
            if (other > end_of_warp) end_of_warp = other;
        }
        if (threadIdx.x == 0) most = begin;
        __syncthreads();
        if (lane == 0) atomicMax(&most, end_of_warp);
        __syncthreads();
        const int end = most;

        float gradient[CHANNELS];
#pragma unroll
        for (int c = 0; c < CHANNELS; ++c) gradient[c] = pixel.inside ? grad_image[pixel.at * CHANNELS + c] : 0;
        const float left = pixel.inside ? transmittances[pixel.at] : 0;  // transmittance behind the last Gaussian
        const float grad_left = pixel.inside ? -grad_alphas[pixel.at] * left : 0;
        float through = left, behind = 0;  // what lies behind, multiplied with the gradient of the pixel

        for (int last = end; last > begin; last -= THREADS) {
            const int first = last - begin > THREADS ? last - THREADS : begin;
            __syncthreads();
            read(batch, list + first, last - first, tile, width, means, conics, colors, opacities);
            __syncthreads();
            const int count = (last < end_of_warp ? last : end_of_warp) - first;
            for (int some = (count - 1) / LANES * LANES; some >= 0 && count > 0; some -= LANES) {
                unsigned bits = __ballot_sync(ALL, some + lane < count && batch.shapes[some + lane].warps >> warp & 1);
                while (bits != 0) {
                    const int highest = 31 - __clz(bits), k = some + highest;
                    bits ^= 1u << highest;
                    const Shape s = batch.shapes[k];
                    const float dx = s.x - pixel.x, dy = s.y - pixel.y;
                    const float fall = falloff(s, dx, dy), alpha = fminf(MAX_ALPHA, s.opacity * fall);
                    const bool blended = first + k < stop && !(alpha < MIN_ALPHA);
                    if (!__any_sync(ALL, blended)) continue;
                    float values[SLOTS] = {};
                    if (blended) {
                        const float rest = __fdividef(1.0f, 1 - alpha);
                        through *= rest;
                        const float weight = alpha * through;
                        float shade = 0;
#pragma unroll
                        for (int c = 0; c < CHANNELS; ++c) {
                            shade += batch.colors[k][c] * gradient[c];
                            values[c] = weight * gradient[c];
                        }
                        const float grad_alpha = through * shade - rest * (behind + grad_left);
                        behind += weight * shade;
                        if (s.opacity * fall <= MAX_ALPHA) {
                            const float grad_exponent = -s.opacity * fall * grad_alpha;
                            const float along_x = 2 * grad_exponent * (s.a * dx + s.b * dy);
                            const float along_y = 2 * grad_exponent * (s.b * dx + s.c * dy);
                            values[CHANNELS] = along_x;
                            values[CHANNELS + 1] = along_y;
                            values[CHANNELS + 2] = 0.5f * grad_exponent * dx * dx;
                            values[CHANNELS + 3] = grad_exponent * dx * dy;
                            values[CHANNELS + 4] = 0.5f * grad_exponent * dy * dy;
                            values[CHANNELS + 5] = fall * grad_alpha;
#if ABSOLUTE
                            values[CHANNELS + 6] = fabsf(along_x);
                            values[CHANNELS + 7] = fabsf(along_y);
#endif
                        }
                    }
                    sum_over_lanes<LANES / 2, SLOTS>(values, lane);
#pragma unroll
                    for (int n = 0; n < KEPT; ++n)
                        if (into[n]) atomicAdd(into[n] + (long long)s.gaussian * stride[n], values[n]);
                }
            }
        }
    }
}
