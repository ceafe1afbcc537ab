#pragma once

#include <cstddef>
#include <string>
#include <string_view>

#include "core/result.h"

namespace tensormass::v1 {
class Body;
}

namespace tensormass::model {

/// A picture on the skin of a body. The server passes it to viewers and looks at its first bytes only.
struct Texture {
  std::string image;        ///< PNG or JPEG; empty: the body has none
  std::string coordinates;  ///< float32 [triangle_count, 3, 2], as in v1::Texture
};

/// Reads the picture of a body whose skin has `triangle_count` triangles; `where` names the body in messages.
/// Returns an empty texture if the scene has none.
///
/// Errors: no skin, an image that is neither PNG nor JPEG or exceeds limits::kMaxTextureBytes, coordinates that are not
/// three places for each triangle, that are not finite, or that exceed limits::kMaxTextureCoordinate.
Result<Texture> read_texture(const v1::Body& body, std::size_t triangle_count, std::string_view where);

}  // namespace tensormass::model
