#include "world/device_loss.h"

#include <algorithm>
#include <cstdlib>
#include <iostream>
#include <string>

#include <gtest/gtest.h>

#include "backend/backend.h"
#include "backend/device_faults.h"

namespace tensormass {
namespace {

using tests::DeviceFault;

class Device : public testing::Test {
 protected:
  void SetUp() override {
    if (const auto backend = backend::make_cuda_backend(); !backend) GTEST_SKIP() << backend.error().message;
  }
};

class DeviceLoss : public Device, public testing::WithParamInterface<DeviceFault> {};

/// Prints CUDA's answers, and ends with 0 if each is seen as a loss of the device.
[[noreturn]] void commit_and_exit(DeviceFault fault) {
  const auto answers = tests::answers_to(fault);
  for (const auto& answer : answers) std::cerr << "a step: " << answer << '\n';
  const bool lost = std::all_of(answers.begin(), answers.end(),
                                [](const auto& answer) { return world::loses_device("a step: " + answer); });
  std::exit(lost && answers.size() == 3 ? 0 : 1);
}

/// In a process of its own, because CUDA works no more in the one that had the fault.
TEST_P(DeviceLoss, IsSeenInWhatCudaSays) {
  GTEST_FLAG_SET(death_test_style, "threadsafe");
  EXPECT_EXIT(commit_and_exit(GetParam()), testing::ExitedWithCode(0), "a step: ");
}

INSTANTIATE_TEST_SUITE_P(Faults, DeviceLoss,
                         testing::Values(DeviceFault::kIllegalAddress, DeviceFault::kMisalignedAddress,
                                         DeviceFault::kAssert, DeviceFault::kTrap));

TEST_F(Device, LacksMemoryAndWorksOn) {
  const std::string answer = tests::answer_to_allocation(std::size_t{1} << 50);
  EXPECT_EQ(answer, "out of memory");
  EXPECT_FALSE(world::loses_device("a scene: " + answer));
  EXPECT_EQ(tests::answer_to_allocation(64), "no error");
}

}  // namespace
}  // namespace tensormass
