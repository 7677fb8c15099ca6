#define HALO (WINDOW - 1)
#define COLUMNS (TILE_WIDTH + HALO)
#define ROWS (TILE_HEIGHT + HALO)

__device__ __forceinline__ float limited(float value, float highest) {
    return fminf(fmaxf(value, 0.0f), highest);  // NaN becomes 0
}

// Bilinear interpolation between pixel centres; coordinates are clamped to the outermost centres.
__device__ __forceinline__ float sample(const float* __restrict__ image, int height, int width, float x, float y) {
    x = limited(x - 0.5f, width - 1);
    y = limited(y - 0.5f, height - 1);
    const int left = (int)x, top = (int)y, right = left + 1 < width ? left + 1 : left;
    const float across = x - left, down = y - top;
    const float *above = image + top * width, *below = image + (top + 1 < height ? top + 1 : top) * width;
    return (1 - down) * ((1 - across) * above[left] + across * above[right]) +
           down * ((1 - across) * below[left] + across * below[right]);
}

// Projects a pixel's centre into another image, homogeneous: M (x, y, 1) + along t. `map` holds the rows of [M | t].
__device__ __forceinline__ void project(const float* __restrict__ map, int row, int column, float along,
                                        float* point) {
#pragma unroll
    for (int k = 0; k < 3; ++k) {
        const float* m = map + 4 * k;
        point[k] = m[0] * (column + 0.5f) + m[1] * (row + 0.5f) + m[2] + along * m[3];
    }
}

// Each block computes the scores of one tile for one plane. `maps` holds the projection into each other image, `shapes`
// the offset of that image in `images`, its height and its width. Pixels outside the image do not count: `size` is the
// number of pixels of each patch, `mean` and `deviation` are those of its grey values.
extern "C" __global__ void correlate(int height, int width, int planes, int others, double farthest,
                                     double nearest, double least,
                                     const float* __restrict__ grey, const float* __restrict__ size,
                                     const float* __restrict__ mean, const float* __restrict__ deviation,
                                     const float* __restrict__ facing, const float* __restrict__ s,
                                     const float* __restrict__ maps, const int* __restrict__ shapes,
                                     const float* __restrict__ images, float* __restrict__ scores) {
    __shared__ float own[ROWS * COLUMNS], seen[ROWS * COLUMNS], partial[3][ROWS * TILE_WIDTH];
    const int across = (width + TILE_WIDTH - 1) / TILE_WIDTH, down = (height + TILE_HEIGHT - 1) / TILE_HEIGHT;
    const int tile = blockIdx.x % (across * down), plane = blockIdx.x / (across * down);
    if (plane >= planes) return;
    const int top = tile / across * TILE_HEIGHT - HALO / 2, left = tile % across * TILE_WIDTH - HALO / 2;
    const float inverse = s[plane];
    for (int i = threadIdx.x; i < ROWS * COLUMNS; i += blockDim.x) {
        const int row = top + i / COLUMNS, column = left + i % COLUMNS;
        const bool outside = row < 0 || column < 0 || row >= height || column >= width;
        own[i] = outside ? 0 : grey[row * width + column];
    }
    for (int other = 0; other < others; ++other) {
        const float *map = maps + 12 * other, *image = images + shapes[3 * other];
        const int other_height = shapes[3 * other + 1], other_width = shapes[3 * other + 2];
        for (int i = threadIdx.x; i < ROWS * COLUMNS; i += blockDim.x) {
            const int row = top + i / COLUMNS, column = left + i % COLUMNS;
            seen[i] = 0;
            if (row < 0 || column < 0 || row >= height || column >= width) continue;
            float point[3];
            project(map, row, column, facing[row * width + column] * inverse, point);
            const float scale = 1 / fmaxf(point[2], 1e-6f);
            seen[i] = sample(image, other_height, other_width, point[0] * scale, point[1] * scale);
        }
        __syncthreads();
        for (int i = threadIdx.x; i < ROWS * TILE_WIDTH; i += blockDim.x) {
            const int first = i / TILE_WIDTH * COLUMNS + i % TILE_WIDTH;
            float sum = 0, squares = 0, products = 0;
#pragma unroll
            for (int k = 0; k < WINDOW; ++k) {
                const float value = seen[first + k];
                sum += value;
                squares += value * value;
                products += value * own[first + k];
            }
            partial[0][i] = sum;
            partial[1][i] = squares;
            partial[2][i] = products;
        }
        __syncthreads();
        for (int i = threadIdx.x; i < TILE_HEIGHT * TILE_WIDTH; i += blockDim.x) {
            const int row = top + HALO / 2 + i / TILE_WIDTH, column = left + HALO / 2 + i % TILE_WIDTH;
            if (row >= height || column >= width) continue;
            float sums[3] = {0, 0, 0};
            for (int t = 0; t < 3; ++t)
#pragma unroll
                for (int k = 0; k < WINDOW; ++k) sums[t] += partial[t][i + k * TILE_WIDTH];
            const int at = row * width + column;
            const float along = facing[at] * inverse;
            float point[3];
            project(map, row, column, along, point);
            const float u = point[0], v = point[1], z = point[2];
            const bool inside = along >= (float)farthest && along <= (float)nearest;
            const bool visible = inside && z > 1e-6f && u > 0 && v > 0 && u < z * other_width && v < z * other_height;
            const float average = sums[0] / size[at];
            const float variance = fmaxf(sums[1] / size[at] - average * average, (float)least);
            const float score = (sums[2] / size[at] - average * mean[at]) / (deviation[at] * sqrtf(variance));
            float* best = scores + (long long)plane * height * width + at;
            const float found = visible ? score : -1.0f;
            *best = other == 0 ? found : fmaxf(*best, found);
        }
        __syncthreads();
    }
}
