#include "core/limits.h"
#include "model/refusals.h"
#include "support/findings.h"

/// Contacts between bodies and attachments that are refused, and those that are loaded with a finding.
namespace tensormass::model {
namespace {

v1::BodyContact& contact(v1::Scene& scene) {
  v1::BodyContact& contact = *scene.add_body_contacts();
  contact.set_body(scene.bodies(0).name());
  return contact;
}
v1::Attachment& attachment(v1::Scene& scene) {
  v1::Attachment& attachment = *scene.add_attachments();
  attachment.set_name("ligament");
  attachment.set_body(scene.bodies(0).name());
  attachment.mutable_region()->mutable_nodes()->add_indices(0);
  attachment.set_other(scene.bodies(0).name());
  attachment.mutable_other_region()->mutable_nodes()->add_indices(1);
  attachment.set_stiffness_n_per_m(1);
  return attachment;
}

std::vector<Refusal> link_refusals() {
  return {
      {"ContactOfNoBody",
       [](auto& s) { contact(s).set_body("lung"); },
       {"scene.body_contacts[0].body", "'lung'", "the scene has 'beam'"}},
      {"ContactWithNoBody", [](auto& s) { contact(s).set_other("lung"); }, {"scene.body_contacts[0].other", "'lung'"}},
      {"ContactTwice",
       [](auto& s) { contact(s), contact(s).set_other("beam"); },
       {"scene.body_contacts[1]", "same two bodies"}},
      {"ContactAtNegativeDistance",
       [](auto& s) { contact(s).set_distance_m(-1); },
       {"scene.body_contacts[0].distance_m", "-1"}},
      {"ContactWithoutStiffness",
       [](auto& s) { contact(s).set_penalty_stiffness_pa_per_m(0); },
       {"scene.body_contacts[0].penalty_stiffness_pa_per_m"}},
      {"ContactOfNanStiffness",
       [](auto& s) { contact(s).set_penalty_stiffness_pa_per_m(kNan); },
       {"scene.body_contacts[0].penalty_stiffness_pa_per_m", "nan"}},
      {"ContactThatPulls",
       [](auto& s) { contact(s).set_friction_coefficient(-0.1); },
       {"scene.body_contacts[0].friction_coefficient"}},
      {"ContactThatReachesTooLittle",
       [](auto& s) {
         contact(s).set_distance_m(0.01);
         s.mutable_body_contacts(0)->set_reach_m(0.01);
       },
       {"scene.body_contacts[0].reach_m", "distance_m = 0.01"}},
      {"TooManyContacts",
       [](auto& s) {
         while (s.body_contacts_size() <= static_cast<int>(limits::kMaxBodyContacts)) contact(s);
       },
       {"scene.body_contacts", "kMaxBodyContacts"},
       ErrorCode::kResourceExhausted},
      {"AttachmentWithoutName", [](auto& s) { attachment(s).clear_name(); }, {"scene.attachments[0].name"}},
      {"TwoAttachmentsOfOneName",
       [](auto& s) { attachment(s), attachment(s); },
       {"scene.attachments[1]", "'ligament'", "taken"}},
      {"AttachmentOfNoBody", [](auto& s) { attachment(s).clear_body(); }, {"attachment 'ligament'.body", "''"}},
      {"AttachmentToNoBody",
       [](auto& s) { attachment(s).set_other("lung"); },
       {"attachment 'ligament'.other", "'lung'"}},
      {"AttachmentOfNoNodes", [](auto& s) { attachment(s).clear_region(); }, {"attachment 'ligament'.region"}},
      {"AttachmentToAMissingSet",
       [](auto& s) { attachment(s).mutable_other_region()->set_set("hilum"); },
       {"attachment 'ligament'.other_region", "hilum"}},
      {"AttachmentOfANodeToItself",
       [](auto& s) { attachment(s).mutable_other_region()->mutable_nodes()->set_indices(0, 0); },
       {"attachment 'ligament'", "node 0", "both regions"}},
      {"AttachmentWithoutStiffness",
       [](auto& s) { attachment(s).set_stiffness_n_per_m(0); },
       {"attachment 'ligament'.stiffness_n_per_m"}},
      {"AttachmentThatTearsAtNothing",
       [](auto& s) { attachment(s).set_breaking_force_n(0); },
       {"attachment 'ligament'.breaking_force_n"}},
  };
}

class RefusedLinks : public testing::TestWithParam<Refusal> {};

TEST_P(RefusedLinks, WithItsPlaceAndItsReason) { expect_refused(GetParam()); }

INSTANTIATE_TEST_SUITE_P(Scenes, RefusedLinks, testing::ValuesIn(link_refusals()),
                         [](const auto& one) { return one.param.name; });

/// Findings about two blocks of 100 mm in contact. The second one begins at this height; surfaces push each other from
/// 1 mm on, and down to 20 mm.
std::vector<std::string> found_at_height(double height_m) {
  tests::Beam block;
  block.size_x_m = block.size_y_m = block.size_z_m = 0.1;
  block.cells_x = block.cells_y = block.cells_z = 4;
  v1::Scene scene = tests::beam_scene(block);
  *scene.add_bodies() = v1::Body(scene.bodies(0));
  v1::Body& other = *scene.mutable_bodies(1);
  other.set_name("other");
  other.clear_fixed();
  tests::set(*other.mutable_mesh()->mutable_grid()->mutable_origin_m(), 0.01, height_m, 0.01);
  v1::BodyContact& touching = contact(scene);
  touching.set_other("other");
  touching.set_distance_m(0.001);
  touching.set_reach_m(0.02);
  const auto model = compile(scene, {});
  EXPECT_TRUE(model) << model.error().message;
  return model ? tests::texts(model->findings, FindingCode::kOverlap) : std::vector<std::string>();
}

/// Bodies that overlap are loaded, and the scene says which nodes of either lie in the other, and what follows.
TEST(BodiesThatOverlap, AreLoadedWithAFinding) {
  const std::vector<std::string> shallow = found_at_height(0.095), deep = found_at_height(0.07);
  // The second block is moved by 10 mm along x and z: 16 nodes of its lower side lie inside the first, and as many of
  // the upper side of the first lie inside it.
  ASSERT_EQ(shallow.size(), 1u);
  EXPECT_NE(shallow[0].find("16 nodes of 'beam' lie inside 'other' and 16 nodes of 'other' lie inside 'beam', the "
                            "deepest by 5 mm. Contact pushes them apart"),
            std::string::npos)
      << shallow[0];
  ASSERT_EQ(deep.size(), 1u);
  EXPECT_NE(deep[0].find("Nodes deeper than the contact's reach_m stay inside"), std::string::npos) << deep[0];
}

/// Blocks that rest on each other, or overlap by less than the distance at which they push, do not overlap.
TEST(BodiesThatOverlap, AreNotThoseThatTouch) {
  for (const double height_m : {0.2, 0.1, 0.0995}) EXPECT_TRUE(found_at_height(height_m).empty()) << height_m;
}

}  // namespace
}  // namespace tensormass::model
