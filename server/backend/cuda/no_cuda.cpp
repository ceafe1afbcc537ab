#include "backend/backend.h"
#include "backend/devices.h"

namespace tensormass::backend {

namespace {

constexpr const char* kNoCuda = "this build is for the CPU alone; `make build CUDA=ON` compiles the CUDA backend";

}  // namespace

Result<std::unique_ptr<Backend>> make_cuda_backend(std::uint32_t /*scenes*/, std::uint32_t /*device*/) {
  return fail(ErrorCode::kUnavailable, kNoCuda);
}

std::vector<std::uint32_t> list_cuda_devices() { return {}; }

Result<DeviceMemory> read_cuda_memory(std::uint32_t /*device*/) { return fail(ErrorCode::kUnavailable, kNoCuda); }

}  // namespace tensormass::backend
