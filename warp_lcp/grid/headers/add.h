// Add to an element that other threads may add to on CUDA; a product as it is there, or fused.
auto add = [](auto& element, auto value) {
#ifdef __CUDA_ARCH__
    atomicAdd(&element, value);
#else
    element += value;
#endif
};
auto add_product = [&](auto& element, auto a, auto b) {
#ifdef __CUDA_ARCH__
    atomicAdd(&element, a*b);
#else
    element = fused(a, b, element);
#endif
};
