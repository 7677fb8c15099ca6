#define HALO (WINDOW - 1)
#define COLUMNS (TILE_WIDTH + HALO)
#define ROWS (TILE_HEIGHT + HALO)
#define C1 (0.01f * 0.01f)
#define C2 (0.03f * 0.03f)

static __device__ const float weights[WINDOW] = {WEIGHTS};

// Weighted sum over the rows of a window, after the filter along them.
__device__ __forceinline__ float filter_column(const float* partial) {
    float sum = 0;
#pragma unroll
    for (int k = 0; k < WINDOW; ++k) sum += weights[k] * partial[k * TILE_WIDTH];
    return sum;
}

// A block has one tile of the images. It sums the absolute differences of its pixels, 1 - SSIM of the windows whose
// first pixel it has, and the absolute differences of the base colours. If `derivatives` is given, it writes the
// derivatives of a window's SSIM with respect to its means of x, x x and x y, one plane for each and each channel.
extern "C" __global__ void compare(int height, int width, const float* __restrict__ image,
                                   const float* __restrict__ base, const float* __restrict__ target,
                                   double l1_weight, double ssim_weight, double base_weight,
                                   float* __restrict__ derivatives, float* __restrict__ losses,
                                   float* __restrict__ base_losses) {
    __shared__ float x[ROWS * COLUMNS], y[ROWS * COLUMNS], partial[5][ROWS * TILE_WIDTH], sums[3][THREADS];
    const int across = (width + TILE_WIDTH - 1) / TILE_WIDTH, tile = blockIdx.x;
    if (tile >= across * ((height + TILE_HEIGHT - 1) / TILE_HEIGHT)) return;
    const int top = tile / across * TILE_HEIGHT, left = tile % across * TILE_WIDTH, thread = threadIdx.x;
    const int windows_high = height - HALO, windows_wide = width - HALO;
    const long long plane = (long long)windows_high * windows_wide;
    float difference = 0, dissimilarity = 0, base_difference = 0;
    for (int c = 0; c < 3; ++c) {
        for (int i = thread; i < ROWS * COLUMNS; i += blockDim.x) {
            const int row = top + i / COLUMNS, column = left + i % COLUMNS;
            const bool inside = row < height && column < width;
            const long long at = ((long long)row * width + column) * 3 + c;
            x[i] = inside ? image[at] : 0;
            y[i] = inside ? target[at] : 0;
            if (i / COLUMNS >= TILE_HEIGHT || i % COLUMNS >= TILE_WIDTH) continue;
            difference += fabsf(x[i] - y[i]);
            if (base && inside) base_difference += fabsf(base[at] - y[i]);
        }
        __syncthreads();
        for (int i = thread; i < ROWS * TILE_WIDTH; i += blockDim.x) {
            const int first = i / TILE_WIDTH * COLUMNS + i % TILE_WIDTH;
            float mean_x = 0, mean_y = 0, xx = 0, yy = 0, xy = 0;
#pragma unroll
            for (int k = 0; k < WINDOW; ++k) {
                const float a = x[first + k], b = y[first + k], w = weights[k];
                mean_x += w * a;
                mean_y += w * b;
                xx += w * a * a;
                yy += w * b * b;
                xy += w * a * b;
            }
            partial[0][i] = mean_x;
            partial[1][i] = mean_y;
            partial[2][i] = xx;
            partial[3][i] = yy;
            partial[4][i] = xy;
        }
        __syncthreads();
        for (int i = thread; i < TILE_HEIGHT * TILE_WIDTH; i += blockDim.x) {
            const int row = top + i / TILE_WIDTH, column = left + i % TILE_WIDTH;
            if (row >= windows_high || column >= windows_wide) continue;
            const float mean_x = filter_column(partial[0] + i), mean_y = filter_column(partial[1] + i);
            const float both = mean_x * mean_y, squares = mean_x * mean_x + mean_y * mean_y;
            const float luminance = 2 * both + C1, structure = 2 * (filter_column(partial[4] + i) - both) + C2;
            const float luminance_max = squares + C1;
            const float structure_max = filter_column(partial[2] + i) + filter_column(partial[3] + i) - squares + C2;
            const float inverse = 1 / (luminance_max * structure_max), value = luminance * structure * inverse;
            dissimilarity += 1 - value;
            if (!derivatives) continue;
            float* derivative = derivatives + c * plane + (long long)row * windows_wide + column;
            // Covariances are means of products minus products of means, so a mean changes both.
            derivative[0] = 2 * (mean_y * (structure - luminance) * inverse +
                                 mean_x * value * (1 / structure_max - 1 / luminance_max));
            derivative[3 * plane] = -value / structure_max;
            derivative[6 * plane] = 2 * luminance * inverse;
        }
        __syncthreads();
    }
    sums[0][thread] = difference;
    sums[1][thread] = dissimilarity;
    sums[2][thread] = base_difference;
    __syncthreads();
    for (int half = blockDim.x / 2; half > 0; half /= 2) {
        if (thread < half)
            for (int s = 0; s < 3; ++s) sums[s][thread] += sums[s][thread + half];
        __syncthreads();
    }
    if (thread) return;
    losses[tile] = l1_weight * sums[0][0] + ssim_weight * sums[1][0];
    if (base) base_losses[tile] = base_weight * sums[2][0];
}

__device__ __forceinline__ float sign_of(float difference) {
    return difference > 0 ? 1.0f : difference < 0 ? -1.0f : difference;  // NaN stays NaN
}

// Gradients of both images, from the derivatives and from the gradients of the losses. A pixel is in the windows that
// begin up to HALO rows above and columns to the left of it.
extern "C" __global__ void compare_backward(int height, int width, const float* __restrict__ image,
                                            const float* __restrict__ base, const float* __restrict__ target,
                                            double l1_weight, double ssim_weight, double base_weight,
                                            const float* __restrict__ derivatives, const float* __restrict__ grad_loss,
                                            const float* __restrict__ grad_base_loss, float* __restrict__ grad_image,
                                            float* __restrict__ grad_base) {
    __shared__ float derivative[3][ROWS * COLUMNS], partial[3][ROWS * TILE_WIDTH];
    const int across = (width + TILE_WIDTH - 1) / TILE_WIDTH, tile = blockIdx.x;
    if (tile >= across * ((height + TILE_HEIGHT - 1) / TILE_HEIGHT)) return;
    const int top = tile / across * TILE_HEIGHT, left = tile % across * TILE_WIDTH;
    const int windows_high = height - HALO, windows_wide = width - HALO;
    const long long plane = (long long)windows_high * windows_wide;
    const float l1_gradient = grad_loss[0] * (float)l1_weight, ssim_gradient = -grad_loss[0] * (float)ssim_weight;
    const float base_gradient = base ? grad_base_loss[0] * (float)base_weight : 0;
    for (int c = 0; c < 3; ++c) {
        for (int i = threadIdx.x; i < ROWS * COLUMNS; i += blockDim.x) {
            const int row = top - HALO + i / COLUMNS, column = left - HALO + i % COLUMNS;
            const bool inside = row >= 0 && column >= 0 && row < windows_high && column < windows_wide;
            const long long at = c * plane + (long long)row * windows_wide + column;
            for (int s = 0; s < 3; ++s) derivative[s][i] = inside ? derivatives[at + 3 * s * plane] : 0;
        }
        __syncthreads();
        for (int i = threadIdx.x; i < ROWS * TILE_WIDTH; i += blockDim.x) {
            const int first = i / TILE_WIDTH * COLUMNS + i % TILE_WIDTH;
            for (int s = 0; s < 3; ++s) {
                float sum = 0;
#pragma unroll
                for (int k = 0; k < WINDOW; ++k) sum += weights[k] * derivative[s][first + k];  // window is symmetric
                partial[s][i] = sum;
            }
        }
        __syncthreads();
        for (int i = threadIdx.x; i < TILE_HEIGHT * TILE_WIDTH; i += blockDim.x) {
            const int row = top + i / TILE_WIDTH, column = left + i % TILE_WIDTH;
            if (row >= height || column >= width) continue;
            const long long at = ((long long)row * width + column) * 3 + c;
            const float a = image[at], b = target[at];
            const float filtered = filter_column(partial[0] + i) + 2 * a * filter_column(partial[1] + i) +
                                   b * filter_column(partial[2] + i);
            grad_image[at] = ssim_gradient * filtered + l1_gradient * sign_of(a - b);
            if (base) grad_base[at] = base_gradient * sign_of(base[at] - b);
        }
        __syncthreads();
    }
}
