#include "model/texture.h"

#include <cmath>
#include <cstring>

#include <fmt/format.h>

#include "core/limits.h"
#include "tensormass/v1/scene.pb.h"

namespace tensormass::model {

namespace {

constexpr std::string_view kPng = "\x89PNG\r\n\x1a\n";
constexpr std::string_view kJpeg = "\xff\xd8\xff";
/// (u, v) at each corner of a triangle.
constexpr std::size_t kNumbersPerTriangle = 6;

Result<void> check_image(const v1::Texture& texture, std::string_view where) {
  if (texture.source_case() != v1::Texture::kImage) {
    return invalid(fmt::format("{}: give the image; the server reads no files", where));
  }
  const std::string& image = texture.image();
  if (image.size() > limits::kMaxTextureBytes) {
    return fail(ErrorCode::kResourceExhausted,
                fmt::format("{}.image: {} bytes exceed limits::kMaxTextureBytes = {}; give it fewer pixels", where,
                            image.size(), limits::kMaxTextureBytes));
  }
  if (!image.starts_with(kPng) && !image.starts_with(kJpeg)) {
    return invalid(
        fmt::format("{}.image: its first bytes are neither those of a PNG nor of a JPEG; convert it", where));
  }
  return {};
}

Result<void> check_coordinates(const std::string& bytes, std::size_t triangle_count, std::string_view where) {
  const std::size_t expected = triangle_count * kNumbersPerTriangle * sizeof(float);
  if (bytes.size() != expected) {
    return invalid(
        fmt::format("{}.coordinates: {} bytes, expected {} (3 corners of 2 float32 for each of {} triangles)", where,
                    bytes.size(), expected, triangle_count));
  }
  for (std::size_t i = 0; i < bytes.size() / sizeof(float); ++i) {
    float value = 0;
    std::memcpy(&value, bytes.data() + i * sizeof(float), sizeof(float));
    if (!(std::abs(value) <= limits::kMaxTextureCoordinate)) {
      return invalid(fmt::format("{}.coordinates: triangle {} has {}, which is not within ±{:g}", where,
                                 i / kNumbersPerTriangle, value, limits::kMaxTextureCoordinate));
    }
  }
  return {};
}

}  // namespace

Result<Texture> read_texture(const v1::Body& body, std::size_t triangle_count, std::string_view where) {
  if (!body.has_texture()) return Texture{};
  const std::string at = fmt::format("{}.texture", where);
  if (!body.has_skin()) return invalid(fmt::format("{}: the body has no skin that it could lie on; give a skin", at));
  TM_RETURN_IF_ERROR(check_image(body.texture(), at));
  TM_RETURN_IF_ERROR(check_coordinates(body.texture().coordinates(), triangle_count, at));
  return Texture{body.texture().image(), body.texture().coordinates()};
}

}  // namespace tensormass::model
