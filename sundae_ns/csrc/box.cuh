__device__ __forceinline__ float nearest(float low, float high) { return low > 0 ? low : high < 0 ? high : 0.0f; }

__device__ __forceinline__ float within(float value, float low, float high) {
    return value < low ? low : value > high ? high : value;
}

// Whether a Gaussian's exponent, a dx^2 + 2 b dx dy + c dy^2, exceeds its reach in all pixels of a box. The box goes
// around the pixels' centres, relative to the Gaussian's. The exponent is least at dy = slope_down dx in a column, and
// at dx = slope_across dy in a row. If the Gaussian's centre is outside the box, the least exponent lies on an edge
// that faces the centre. NaN returns false, which leaves the decision to the blending.
__device__ __forceinline__ bool misses_box(float a, float b, float c, float slope_down, float slope_across, float reach,
                                           float left, float right, float up, float down) {
    const float near_x = nearest(left, right), near_y = nearest(up, down);
    float squares = 0, least = 0;  // in thin Gaussians large terms cancel: the slack grows with them
    if (near_x != 0) {
        const float dy = within(slope_down * near_x, up, down);
        squares = a * near_x * near_x + c * dy * dy;
        least = squares + 2 * b * near_x * dy;
    }
    if (near_y != 0) {
        const float dx = within(slope_across * near_y, left, right);
        const float other = a * dx * dx + c * near_y * near_y, sum = other + 2 * b * dx * near_y;
        if (near_x == 0 || !(sum >= least)) {
            squares = other;
            least = sum;
        }
    }
    return least > reach + ROUNDING * (1 + squares);
}
