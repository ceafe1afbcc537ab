#include "model/material_input.h"

#include <cmath>
#include <functional>
#include <limits>
#include <set>

#include <gtest/gtest.h>

#include "support/laws.h"

/// Tests that every law's message must pass. The laws come from physics/lists.h, so a new law is tested here without a
/// change.
namespace tensormass::model {
namespace {

using google::protobuf::FieldDescriptor;
using google::protobuf::Message;

constexpr double kYoungPa = 4e3, kPoisson = 0.4;

Message& constants_of(v1::Law& law, const std::string& name) {
  return *law.GetReflection()->MutableMessage(&law, v1::Law::descriptor()->FindFieldByName(name));
}

/// Calls visit(message, number's field, name of the field that the law states) for each number, those of vectors too.
void for_each_number(Message& message, const std::string& stated,
                     const std::function<void(Message&, const FieldDescriptor*, const std::string&)>& visit) {
  for (int i = 0; i < message.GetDescriptor()->field_count(); ++i) {
    const FieldDescriptor* field = message.GetDescriptor()->field(i);
    const std::string name = stated.empty() ? field->name() : stated;
    if (field->cpp_type() == FieldDescriptor::CPPTYPE_MESSAGE) {
      for_each_number(*message.GetReflection()->MutableMessage(&message, field), name, visit);
    } else {
      visit(message, field, name);
    }
  }
}

TEST(Laws, AreThoseOfTheProtocol) {
  std::set<std::string> kinds, laws;
  const auto* kind = v1::Law::descriptor()->FindOneofByName("kind");
  for (int i = 0; i < kind->field_count(); ++i) kinds.insert(kind->field(i)->name());
  for (const std::string& name : tests::law_names()) laws.insert(name);
  EXPECT_EQ(kinds, laws) << "Law.kind of scene.proto and kName of each law of physics/lists.h";
}

class EveryLaw : public testing::TestWithParam<std::string> {};

/// Pa for Pa, and each constant in its place.
TEST_P(EveryLaw, HasTheModuliAtRestThatItsMessageStates) {
  for (const double poisson : {-0.999, -0.3, 0.0, 0.3, 0.4999}) {
    const auto material = read_law(tests::law(GetParam(), kYoungPa, poisson), {}, "law");
    ASSERT_TRUE(material) << material.error().message;
    EXPECT_NEAR(material->young_modulus_pa, kYoungPa, 1e-9 * kYoungPa);
    EXPECT_NEAR(material->poisson_ratio, poisson, 1e-9);
  }
}

TEST_P(EveryLaw, RefusesEachConstantThatIsNotFiniteOrAbsurd) {
  constexpr double kInfinity = std::numeric_limits<double>::infinity();
  v1::Law law = tests::law(GetParam(), kYoungPa, kPoisson);
  int numbers = 0;
  for_each_number(constants_of(law, GetParam()), "",
                  [&](Message& message, const FieldDescriptor* field, const std::string& stated) {
                    ++numbers;
                    const double good = message.GetReflection()->GetDouble(message, field);
                    for (const double bad : {std::nan(""), kInfinity, -kInfinity, 1e300, -1e300}) {
                      message.GetReflection()->SetDouble(&message, field, bad);
                      const auto material = read_law(law, {}, "law");
                      ASSERT_FALSE(material) << stated << " = " << bad << " was admitted";
                      EXPECT_NE(material.error().message.find(stated), std::string::npos) << material.error().message;
                    }
                    message.GetReflection()->SetDouble(&message, field, good);
                  });
  EXPECT_GE(numbers, 2);
}

INSTANTIATE_TEST_SUITE_P(Laws, EveryLaw, testing::ValuesIn(tests::law_names()),
                         [](const auto& one) { return one.param; });

}  // namespace
}  // namespace tensormass::model
