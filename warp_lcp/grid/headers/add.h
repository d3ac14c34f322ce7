// Add to an element that other threads may add to.
auto add = [](auto& element, auto value) {
#ifdef __CUDA_ARCH__
    atomicAdd(&element, value);
#else
    element += value;
#endif
};
