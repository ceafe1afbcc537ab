#include "step/finding_message.h"

#include <string>

#include "core/finding_kinds.h"
#include "tensormass/v1/control.pb.h"
#include "tensormass/v1/finding.pb.h"
#include "tensormass/v1/stream.pb.h"

namespace tensormass::step {

namespace {

template <class Message>
void add_with_warning(const Finding& finding, Message& message) {
  *message.add_findings() = to_message(finding);
  // Not as an argument: without memory for an element, protobuf 3.21 would destroy one that it does not have.
  if (finding.accepted.empty()) *message.add_warnings() = finding.text();
}

}  // namespace

v1::Finding to_message(const Finding& finding) {
  v1::Finding out;
  out.set_code(static_cast<v1::FindingCode>(finding.code));
  out.set_value(finding.value);
  out.set_limit(finding.limit);
  out.set_unit(std::string(kind_of(finding.code).unit));
  out.set_place(finding.place);
  out.set_body(finding.body);
  out.set_other(finding.other);
  out.set_tool(finding.tool);
  out.set_message(finding.message);
  out.set_remedy(finding.remedy);
  out.set_accepted(finding.accepted);
  return out;
}

void add(const Finding& finding, v1::SceneReport& report) { add_with_warning(finding, report); }
void add(const Finding& finding, v1::SceneStatus& status) { add_with_warning(finding, status); }
void add_of_load(const Finding& finding, v1::SceneStatus& status) { *status.add_findings() = to_message(finding); }

std::string_view name_of(const v1::Finding& finding) { return kind_of(static_cast<FindingCode>(finding.code())).name; }

bool is_of_results(const v1::Finding& finding) { return !kind_of(static_cast<FindingCode>(finding.code())).at_load; }

}  // namespace tensormass::step
