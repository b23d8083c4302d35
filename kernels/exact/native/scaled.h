// Wide integers of finite numbers divided by a power of two that divides them, and differences of these.

const auto scaled = [](wp::float64 value, int exponent, auto& x) {
    constexpr int L = sizeof(x) / 8;
    union {
        wp::float64 value;
        wp::uint64 bits;
    } word;
    word.value = value;
    const int field = (int)((word.bits >> 52) & 2047);
    wp::uint64 mantissa = word.bits & ((1ull << 52) - 1);
    if (field > 0)
        mantissa |= 1ull << 52;
#if !defined(__CUDA_ARCH__)
    if constexpr (L == 1) {
        if (field > 0 && exponent > -1023 && exponent < 1023 && field - 1023 - exponent < 62) {
            word.bits = (wp::uint64)(1023 - exponent) << 52;
            x[0] = (wp::uint64)(long long)(value * word.value);
            return;
        }
    }
#endif
    int shift = (field > 0 ? field : 1) - 1075 - exponent;
    if (shift < 0) {
        mantissa = shift > -64 ? mantissa >> -shift : 0;
        shift = 0;
    }
    const wp::uint64 mask = 0 - (word.bits >> 63);
    wp::uint64 carry = word.bits >> 63;
    for (int i = 0; i < L; ++i) {
        const int from = 64 * i - shift;  // bit of the mantissa that is the lowest of this limb
        wp::uint64 limb = 0;
        if (from > -64 && from <= 0)
            limb = mantissa << -from;
        else if (from > 0 && from < 64)
            limb = mantissa >> from;
        x[i] = (limb ^ mask) + carry;
        carry &= x[i] == 0;
    }
};
const auto difference = [](const auto& x, const auto& y, auto& d) {
    wp::uint64 borrow = 0;
    for (int i = 0; i < (int)(sizeof(x) / 8); ++i) {
        d[i] = x[i] - y[i] - borrow;
        borrow = (x[i] < y[i]) | ((x[i] == y[i]) & borrow);
    }
};
