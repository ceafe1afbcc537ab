#include "backend/backend.h"

namespace tensormass::backend {

Result<std::unique_ptr<Backend>> make_cuda_backend(std::uint32_t /*scenes*/) {
  return fail(ErrorCode::kUnavailable,
              "this build is for the CPU alone; `make build CUDA=ON` compiles the CUDA backend");
}

}  // namespace tensormass::backend
