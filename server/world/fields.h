#pragma once

#include "backend/backend.h"
#include "model/model.h"
#include "tensormass/v1/control.pb.h"

/// Stresses, reactions and energies for analyses. A step does not compute them, so a request pays for them.
namespace tensormass::world {

/// Fills fields and energies of `body` from a scene's state, in double precision on the host, whatever the scene's
/// precision. time_s: simulated time of the state, at which scheduled loads have their factors. Errors: an unknown
/// field.
Result<v1::GetFieldsResponse> measure_fields(const model::Model& model, const backend::RowState& state, double time_s,
                                             const model::BodyModel& body, const v1::GetFieldsRequest& request);

}  // namespace tensormass::world
