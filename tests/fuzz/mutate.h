#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <cstring>
#include <limits>
#include <random>
#include <string>
#include <vector>

#include <google/protobuf/descriptor.h>
#include <google/protobuf/message.h>

/// Random changes of bytes and of protobuf messages: the same seed gives the same ones on every machine.
namespace tensormass::fuzz {

class Random {
 public:
  explicit Random(std::uint64_t seed) : engine_(seed) {}

  /// A number below `count`.
  std::size_t below(std::size_t count) { return static_cast<std::size_t>(engine_() % count); }
  std::uint64_t bits() { return engine_(); }
  template <class Items>
  const auto& one_of(const Items& items) {
    return items[below(std::size(items))];
  }

 private:
  std::mt19937_64 engine_;
};

inline double odd_number(Random& random) {
  using Limits = std::numeric_limits<double>;
  constexpr std::array<double, 16> kOdd{0,
                                        -0.0,
                                        1,
                                        -1,
                                        Limits::quiet_NaN(),
                                        Limits::infinity(),
                                        -Limits::infinity(),
                                        1e308,
                                        -1e308,
                                        1e-308,
                                        1e30,
                                        Limits::denorm_min(),
                                        0.5,
                                        1e6,
                                        3.5e38,
                                        1e-20};
  return random.one_of(kOdd);
}
inline std::uint64_t odd_integer(Random& random) {
  constexpr std::array<std::uint64_t, 12> kOdd{0,
                                               1,
                                               2,
                                               3,
                                               7,
                                               1000,
                                               0x7fffffff,
                                               0x80000000,
                                               0xffffffff,
                                               0x7fffffffffffffff,
                                               0x8000000000000000,
                                               ~std::uint64_t{0}};
  return random.below(3) == 0 ? random.below(40) : random.one_of(kOdd);
}

/// Changes bytes at one place.
inline void mutate(std::string& bytes, Random& random) {
  const std::size_t at = random.below(bytes.size() + 1);
  const std::size_t count = std::min(bytes.size() - at, std::size_t{1} << random.below(10));
  const auto put = [&](const void* from, std::size_t size) {
    if (at + size > bytes.size()) bytes.resize(at + size);
    std::memcpy(bytes.data() + at, from, size);
  };
  switch (random.below(8)) {
    case 0:
      if (at < bytes.size()) bytes[at] = static_cast<char>(bytes[at] ^ (1 << random.below(8)));
      break;
    case 1:
      for (std::size_t i = at; i < at + count; ++i) bytes[i] = static_cast<char>(random.bits());
      break;
    case 2:
      bytes.erase(at, count);
      break;
    case 3:
      bytes.insert(at, bytes.substr(at, count));
      break;
    case 4:
      bytes.resize(at);
      break;
    case 5: {
      const double number = odd_number(random);
      put(&number, sizeof number);
      break;
    }
    case 6: {
      const auto number = static_cast<float>(odd_number(random));
      put(&number, sizeof number);
      break;
    }
    default: {
      const std::uint64_t number = odd_integer(random);
      put(&number, std::size_t{1} << random.below(4));
    }
  }
}

/// A value in a message: a field, or an element of a repeated one.
class Place {
 public:
  using Field = google::protobuf::FieldDescriptor;
  using Message = google::protobuf::Message;

  /// at: the element; -1: the field is not repeated.
  Place(Message& message, const Field& field, int at) : message_(message), field_(field), at_(at) {}

  Message& message() const {
    return *(at_ < 0 ? of().MutableMessage(&message_, &field_) : of().MutableRepeatedMessage(&message_, &field_, at_));
  }
  void set_odd(Random& random) const {
    switch (field_.cpp_type()) {
      case Field::CPPTYPE_DOUBLE:
        return set(&Reflection::SetDouble, &Reflection::SetRepeatedDouble, odd_number(random));
      case Field::CPPTYPE_FLOAT:
        return set(&Reflection::SetFloat, &Reflection::SetRepeatedFloat, static_cast<float>(odd_number(random)));
      case Field::CPPTYPE_INT32:
        return set(&Reflection::SetInt32, &Reflection::SetRepeatedInt32,
                   static_cast<std::int32_t>(odd_integer(random)));
      case Field::CPPTYPE_UINT32:
        return set(&Reflection::SetUInt32, &Reflection::SetRepeatedUInt32,
                   static_cast<std::uint32_t>(odd_integer(random)));
      case Field::CPPTYPE_INT64:
        return set(&Reflection::SetInt64, &Reflection::SetRepeatedInt64,
                   static_cast<std::int64_t>(odd_integer(random)));
      case Field::CPPTYPE_UINT64:
        return set(&Reflection::SetUInt64, &Reflection::SetRepeatedUInt64, odd_integer(random));
      case Field::CPPTYPE_BOOL:
        return set(&Reflection::SetBool, &Reflection::SetRepeatedBool, random.below(2) == 0);
      case Field::CPPTYPE_ENUM:
        return set(&Reflection::SetEnumValue, &Reflection::SetRepeatedEnumValue, static_cast<int>(random.below(12)));
      case Field::CPPTYPE_STRING: {
        std::string text = at_ < 0 ? of().GetString(message_, &field_) : of().GetRepeatedString(message_, &field_, at_);
        mutate(text, random);
        return set(&Reflection::SetString, &Reflection::SetRepeatedString, std::move(text));
      }
      case Field::CPPTYPE_MESSAGE:
        return;
    }
  }

 private:
  using Reflection = google::protobuf::Reflection;
  const Reflection& of() const { return *message_.GetReflection(); }
  template <class Single, class Repeated, class Value>
  void set(Single single, Repeated repeated, Value value) const {
    if (at_ < 0) return (of().*single)(&message_, &field_, std::move(value));
    (of().*repeated)(&message_, &field_, at_, std::move(value));
  }

  Message& message_;
  const Field& field_;
  const int at_;
};

/// Changes one field of a message, or of a message in it.
inline void mutate(google::protobuf::Message& message, Random& random) {
  const google::protobuf::Descriptor& type = *message.GetDescriptor();
  const google::protobuf::Reflection& of = *message.GetReflection();
  if (type.field_count() == 0) return;
  const google::protobuf::FieldDescriptor* field = nullptr;
  for (int i = 0; i < 6; ++i) {  // most often one that is there
    field = type.field(static_cast<int>(random.below(static_cast<std::size_t>(type.field_count()))));
    if (field->is_repeated() ? of.FieldSize(message, field) > 0 : of.HasField(message, field)) break;
  }
  const bool is_message = field->cpp_type() == google::protobuf::FieldDescriptor::CPPTYPE_MESSAGE;
  int at = -1;
  if (field->is_repeated()) {
    const int size = of.FieldSize(message, field);
    at = size > 0 ? static_cast<int>(random.below(static_cast<std::size_t>(size))) : 0;
    const std::size_t what = random.below(5);
    if (what == 0 && size > 1) return of.SwapElements(&message, field, at, size - 1);
    if (what == 1 && size > 0) return of.RemoveLast(&message, field);
    if (what == 2 && is_message && size < 100) {
      google::protobuf::Message& added = *of.AddMessage(&message, field);
      if (size > 0) added.CopyFrom(of.GetRepeatedMessage(message, field, at));
      return mutate(added, random);
    }
    if (size == 0) return;
  } else if (random.below(12) == 0) {
    return of.ClearField(&message, field);
  }
  const Place place(message, *field, at);
  is_message ? mutate(place.message(), random) : place.set_odd(random);
}

}  // namespace tensormass::fuzz
