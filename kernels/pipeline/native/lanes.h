// Eight numbers at a time, in any precision.

typedef double Doubles __attribute__((ext_vector_type(8)));
typedef float Floats __attribute__((ext_vector_type(8), aligned(4)));
typedef int Ints __attribute__((ext_vector_type(8), aligned(4)));
typedef decltype(Doubles() < Doubles()) Longs;
typedef bool Bools __attribute__((ext_vector_type(8)));
const Ints lanes = {0, 1, 2, 3, 4, 5, 6, 7};

auto bits = [](auto mask) -> int { return __builtin_bit_cast(unsigned char, __builtin_convertvector(mask, Bools)); };
// one instruction each, unlike __builtin_elementwise_min, which prefers numbers to NaN in either argument
auto least = [](auto a, auto b) { return b < a ? b : a; };
auto most = [](auto a, auto b) { return b > a ? b : a; };

// rows of boxes are lowest coordinates and highest ones in turn
auto outer = [=](int row, Floats a, Floats b) { return row % 2 ? most(a, b) : least(a, b); };
auto outermost = [=](int row, Floats a) -> float {
    a = outer(row, a, __builtin_shufflevector(a, a, 4, 5, 6, 7, 0, 1, 2, 3));
    a = outer(row, a, __builtin_shufflevector(a, a, 2, 3, 0, 1, 6, 7, 4, 5));
    return outer(row, a, __builtin_shufflevector(a, a, 1, 0, 3, 2, 5, 4, 7, 6))[0];
};
