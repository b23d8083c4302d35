// The body of make_narrow_polygon; largest_bits is how many bits a corner may have.

#if defined(__CUDA_ARCH__)
return -1;
#else
typedef double Doubles __attribute__((ext_vector_type(8)));
typedef decltype(Doubles() < Doubles()) Longs;
constexpr long long top = 1ll << 52, limit = 1ll << largest_bits, none = 4096;
// x, y and z of each point at the start, and at the end from the fifth lane on
Doubles x[4];
Longs lowest = none, bad = 0, wide = 0, n[4];
for (int i = 0; i < 4; ++i) {
    const auto &a = query.data[i], &b = query.data[i + 4];
    x[i] = Doubles{a[0], a[1], a[2], 0.0, b[0], b[1], b[2], 0.0};
    const Longs word = __builtin_bit_cast(Longs, x[i]);
    const Longs field = (word >> 52) & 2047, mantissa = word & (top - 1);
    // not by a comparison of the whole word, which a compiler makes one of numbers, that takes subnormals for zero
    const Longs is_zero = field == 0;
    bad |= (is_zero & (mantissa != 0)) | (field == 2047);  // subnormal, or not finite
    const Longs bits = mantissa | top, lowest_bit = bits & -bits;
    const Longs place = __builtin_bit_cast(Longs, __builtin_convertvector(lowest_bit, Doubles)) >> 52;
    lowest = __builtin_elementwise_min(lowest, is_zero ? Longs(none) : field + place - (1075 + 1023));
}
lowest = __builtin_elementwise_min(lowest, __builtin_shufflevector(lowest, lowest, 4, 5, 6, 7, 0, 1, 2, 3));
lowest = lowest == none ? Longs(0) : lowest;  // all are zero
bad |= (lowest <= -1023) | (lowest >= 1023);
for (int i = 0; i < 4; ++i) {
    const Doubles whole = x[i] * __builtin_bit_cast(Doubles, (1023 - lowest) << 52);
    bad |= __builtin_elementwise_abs(whole) >= 0x1p62;
    n[i] = __builtin_convertvector(whole, Longs);
}
if (__builtin_reduce_or(bad))
    return -1;
for (int i = 0; i < 4; ++i) {
    const Longs corner = edges ? n[i < 2 ? 2 : 3] - n[i == 1 || i == 2] : n[0] - n[i < 3 ? i + 1 : 3];
    wide |= (corner >= limit) | (corner <= -limit);
    for (int axis = 0; axis < 3; ++axis) {
        polygon.data[3 * i + axis][0] = (wp::uint64)corner[axis];
        polygon.data[3 * (i + 4) + axis][0] = (wp::uint64)corner[axis + 4];
    }
}
return __builtin_reduce_or(wide) ? 0 : 1;
#endif
