// SPDX-License-Identifier: Apache-2.0
// A build of torch without CUDA refuses to choose a CUDA device, which indexing a tensor there begins with. This gives
// it a choice that does nothing.
#include <c10/core/impl/DeviceGuardImplInterface.h>

extern "C" void ggslam_register_guard() {
  static const c10::impl::NoOpDeviceGuardImpl<c10::DeviceType::CUDA> guard;
  if (!c10::impl::hasDeviceGuardImpl(c10::DeviceType::CUDA))
    c10::impl::registerDeviceGuard(c10::DeviceType::CUDA, &guard);
}
