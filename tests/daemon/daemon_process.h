#pragma once

#include <fcntl.h>
#include <sys/wait.h>
#include <unistd.h>

#include <chrono>
#include <csignal>
#include <filesystem>
#include <fstream>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

// For the thread sanitizer this header gives maps a member that those of the installed library do not have.
#pragma push_macro("__SANITIZE_THREAD__")
#undef __SANITIZE_THREAD__
#include <google/protobuf/struct.pb.h>
#pragma pop_macro("__SANITIZE_THREAD__")
#include <google/protobuf/util/json_util.h>
#include <grpcpp/grpcpp.h>
#include <gtest/gtest.h>

#include "support/eventually.h"
#include "support/grpc_channel.h"
#include "tensormass/v1/control.grpc.pb.h"

/// Runs the real program as users start it: a process with flags, a log and a ready file.
namespace tensormass::daemon_tests {

inline constexpr std::chrono::seconds kDeadline{30};

template <class Condition>
bool eventually(const Condition& condition) {
  return tests::eventually(condition, kDeadline);
}

/// A new folder, removed with its contents by the destructor.
class TemporaryFolder {
 public:
  TemporaryFolder() {
    std::string path = (std::filesystem::temp_directory_path() / "tensormass-test-XXXXXX").string();
    if (mkdtemp(path.data()) == nullptr) throw std::runtime_error("mkdtemp");
    path_ = path;
  }
  ~TemporaryFolder() { std::filesystem::remove_all(path_); }
  std::filesystem::path operator/(const std::string& name) const { return path_ / name; }

 private:
  std::filesystem::path path_;
};

inline std::string read_file(const std::filesystem::path& path) {
  std::ostringstream text;
  text << std::ifstream(path).rdbuf();
  return text.str();
}

/// A child process that writes stdout and stderr to a file. The destructor kills it.
class Process {
 public:
  Process(const std::vector<std::string>& arguments, const std::filesystem::path& output,
          const std::vector<std::string>& environment = {}) {
    child_ = fork();
    if (child_ != 0) return;
    const int file = open(output.c_str(), O_WRONLY | O_CREAT | O_TRUNC, 0600);
    dup2(file, STDOUT_FILENO);
    dup2(file, STDERR_FILENO);
    for (const std::string& variable : environment) putenv(const_cast<char*>(variable.c_str()));
    std::vector<char*> argv;
    for (const std::string& argument : arguments) argv.push_back(const_cast<char*>(argument.c_str()));
    argv.push_back(nullptr);
    execv(argv[0], argv.data());
    _exit(127);
  }
  ~Process() {
    if (status_) return;
    ::kill(child_, SIGKILL);
    wait();
  }
  Process(const Process&) = delete;
  Process& operator=(const Process&) = delete;

  pid_t id() const { return child_; }
  void kill(int signal) const { ::kill(child_, signal); }
  bool running() {
    if (!status_) {
      int status = 0;
      if (waitpid(child_, &status, WNOHANG) == child_) status_ = status;
    }
    return !status_;
  }
  /// Waits for the end. Returns the exit status, or 128 + n if signal n ended the process.
  int wait() {
    if (!status_) {
      int status = 0;
      waitpid(child_, &status, 0);
      status_ = status;
    }
    return WIFEXITED(*status_) ? WEXITSTATUS(*status_) : 128 + WTERMSIG(*status_);
  }

 private:
  pid_t child_ = -1;
  std::optional<int> status_;
};

/// `tensormassd` on the CPU and on free ports. It serves when the constructor returns.
class DaemonProcess {
 public:
  explicit DaemonProcess(std::vector<std::string> more = {}) {
    std::vector<std::string> arguments{TENSORMASSD,          "--backend",       "cpu",
                                       "--control",          "127.0.0.1:0",     "--zeromq-publish",
                                       "tcp://127.0.0.1:*",  "--zeromq-pose",   "tcp://127.0.0.1:*",
                                       "--zenoh-listen",     "tcp/127.0.0.1:0", "--ready-file",
                                       ready_file().string()};
    arguments.insert(arguments.end(), more.begin(), more.end());
    process.emplace(arguments, folder / "log");
    if (!eventually([&] { return std::filesystem::exists(ready_file()) || !process->running(); }) ||
        !process->running()) {
      throw std::runtime_error("tensormassd did not start: " + log());
    }
    ready_text = read_file(ready_file());
    if (!google::protobuf::util::JsonStringToMessage(ready_text, &ready_).ok()) {
      throw std::runtime_error("not JSON: " + ready_text);
    }
    stub = v1::Control::NewStub(tests::connected_channel(endpoint("control")));
  }

  std::filesystem::path ready_file() const { return folder / "ready.json"; }
  std::string log() const { return read_file(folder / "log"); }
  /// An endpoint from the ready file; `name` is "control", "zeromq_publish", "zeromq_pose" or "zenoh".
  std::string endpoint(const std::string& name) const { return ready_.fields().at(name).string_value(); }

  void load(const v1::Scene& scene) {
    grpc::ClientContext context;
    v1::LoadSceneRequest request;
    *request.mutable_scene() = scene;
    v1::LoadSceneResponse response;
    const grpc::Status status = stub->LoadScene(&context, request, &response);
    if (!status.ok()) throw std::runtime_error(status.error_message());
  }
  v1::GetVersionResponse version() {
    grpc::ClientContext context;
    v1::GetVersionResponse response;
    const grpc::Status status = stub->GetVersion(&context, {}, &response);
    EXPECT_TRUE(status.ok()) << status.error_message();
    return response;
  }
  v1::SceneStatus status(const std::string& scene) {
    grpc::ClientContext context;
    v1::GetStatusRequest request;
    request.set_scene(scene);
    v1::GetStatusResponse response;
    const grpc::Status got = stub->GetStatus(&context, request, &response);
    EXPECT_TRUE(got.ok()) << got.error_message();
    return response.status();
  }

  TemporaryFolder folder;
  std::optional<Process> process;
  std::string ready_text;
  std::unique_ptr<v1::Control::Stub> stub;

 private:
  google::protobuf::Struct ready_;
};

}  // namespace tensormass::daemon_tests
