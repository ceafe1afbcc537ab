#pragma once

#include <cstddef>

/// Limits of attachments that EditScene adds. Error messages name the limit by its identifier. A file of their own,
/// because limits.h is part of every kernel; kMaxAttachments is there.
namespace tensormass::limits {

/// Springs of attachments that EditScene has added and not removed; an edit that would bring more is refused. Frames of
/// a scene with editing have room for their ends, 0.1 MB each.
inline constexpr std::size_t kMaxAddedSprings = 4096;
/// Energy in the springs of an attachment when it comes [J]; one with more is refused. It would throw what it holds.
inline constexpr double kMaxAttachmentEnergyJ = 100;

}  // namespace tensormass::limits
