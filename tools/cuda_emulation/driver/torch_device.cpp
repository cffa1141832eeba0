// What PyTorch's C++ asks of a CUDA device: that there is one, and which is the current one. Tensors that say they are on
// it live in torch_device.py; here autograd learns that it owes the device a thread of its own.
#include <ATen/detail/CUDAHooksInterface.h>
#include <c10/core/impl/DeviceGuardImplInterface.h>
#include <new>

namespace {

const c10::Device first_device(c10::DeviceType::CUDA, 0);
const c10::Stream default_stream(c10::Stream::DEFAULT, first_device);

struct Guard final : c10::impl::NoOpDeviceGuardImpl<c10::DeviceType::CUDA> {
    c10::Device exchangeDevice(c10::Device) const override { return first_device; }
    c10::Device getDevice() const override { return first_device; }
    c10::Stream getStream(c10::Device) const noexcept override { return default_stream; }
    c10::Stream getDefaultStream(c10::Device) const override { return default_stream; }
    c10::Stream exchangeStream(c10::Stream) const noexcept override { return default_stream; }
};

struct Hooks final : at::CUDAHooksInterface {
    void init() const override {}
    bool isBuilt() const override { return true; }
    bool isAvailable() const override { return true; }
    bool hasCUDA() const override { return true; }
    bool hasPrimaryContext(c10::DeviceIndex) const override { return false; }
    c10::DeviceIndex deviceCount() const override { return 1; }
    c10::DeviceIndex getCurrentDevice() const override { return 0; }
};

const Guard guard;

}  // namespace

// PyTorch has made its hooks when it was imported, so ours take their place in memory: neither class has members.
extern "C" void add_emulated_cuda_device() {
    static_assert(sizeof(Hooks) == sizeof(at::CUDAHooksInterface));
    auto &hooks = const_cast<at::CUDAHooksInterface &>(at::detail::getCUDAHooks());
    new (static_cast<void *>(&hooks)) Hooks;
    c10::impl::device_guard_impl_registry[static_cast<size_t>(c10::DeviceType::CUDA)].store(&guard);
}
