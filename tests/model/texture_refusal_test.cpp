#include <cmath>
#include <string>
#include <vector>

#include "core/limits.h"
#include "model/refusals.h"

/// Pictures on bodies that are refused.
namespace tensormass::model {
namespace {

template <class Item>
std::string bytes(const std::vector<Item>& items) {
  return {reinterpret_cast<const char*>(items.data()), items.size() * sizeof(Item)};
}

/// A skin of one triangle inside the block, with a picture that is admitted.
v1::Texture& textured_skin(v1::Scene& scene) {
  v1::Body& body = *scene.mutable_bodies(0);
  v1::PackedTriangles& skin = *body.mutable_skin()->mutable_packed();
  skin.set_vertex_positions(bytes(std::vector<double>{0, 0, 0, 1e-3, 0, 0, 0, 1e-3, 0}));
  skin.set_triangles(bytes(std::vector<std::uint32_t>{0, 1, 2}));
  body.mutable_texture()->set_image("\xff\xd8\xff");
  body.mutable_texture()->set_coordinates(bytes(std::vector<float>(6)));
  return *body.mutable_texture();
}

std::vector<Refusal> texture_refusals() {
  return {
      {"TextureWithoutSkin",
       [](auto& s) {
         textured_skin(s);
         s.mutable_bodies(0)->clear_skin();
       },
       {"body 'beam'.texture", "no skin"}},
      {"TextureFile",
       [](auto& s) { textured_skin(s).set_file("liver.png"); },
       {"body 'beam'.texture", "give the image"}},
      {"TextureOfAnotherFormat",
       [](auto& s) { textured_skin(s).set_image("GIF89a"); },
       {"body 'beam'.texture.image", "PNG"}},
      {"LargeTexture",
       [](auto& s) { textured_skin(s).set_image("\xff\xd8\xff" + std::string(limits::kMaxTextureBytes, ' ')); },
       {"body 'beam'.texture.image", "limits::kMaxTextureBytes"},
       ErrorCode::kResourceExhausted},
      {"TextureOfAnotherSkin",
       [](auto& s) { textured_skin(s).set_coordinates(bytes(std::vector<float>(12))); },
       {"body 'beam'.texture.coordinates", "48 bytes, expected 24"}},
      {"TextureCoordinateNaN",
       [](auto& s) {
         textured_skin(s).set_coordinates(bytes(std::vector<float>{0, 0, 0, 0, 0, std::nanf("")}));
       },
       {"body 'beam'.texture.coordinates", "triangle 0 has nan"}},
  };
}

TEST(AdmittedTexture, IsTheOneThatTheRefusalsSpoil) {
  v1::Scene scene = admitted_scene();
  textured_skin(scene);
  const auto model = compile(scene, {});
  EXPECT_TRUE(model) << model.error().message;
}

class RefusedTexture : public testing::TestWithParam<Refusal> {};

TEST_P(RefusedTexture, WithItsPlaceAndItsReason) { expect_refused(GetParam()); }

INSTANTIATE_TEST_SUITE_P(Scenes, RefusedTexture, testing::ValuesIn(texture_refusals()),
                         [](const auto& one) { return one.param.name; });

}  // namespace
}  // namespace tensormass::model
