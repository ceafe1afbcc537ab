#include "backend/backend.h"

namespace tensormass::backend {

Result<std::unique_ptr<Backend>> make_cuda_backend(std::uint32_t /*scenes*/) {
  return fail(ErrorCode::kUnavailable, "this build has no CUDA; configure with -DTENSORMASS_CUDA=ON");
}

}  // namespace tensormass::backend
