#pragma once

#include <memory>
#include <mutex>
#include <utility>

#include "model/model.h"

namespace tensormass::model {

/// Keeps the memory of a Model that nobody uses any more, for the next one of its scene (values.h): the system takes
/// longer to give as much memory than the new numbers take. Thread-safe.
class SpareModel {
 public:
  /// Returns the model that is kept, if a compile made it together with `like`, otherwise a copy of `like`. They may
  /// differ in what with_values changes.
  std::unique_ptr<Model> take(const Model& like) {
    std::unique_ptr<Model> kept;
    {
      const std::lock_guard lock(shelf_->mutex);
      kept.swap(shelf_->model);
    }
    if (kept != nullptr && kept->value_tables == like.value_tables) return kept;
    kept.reset();
    return std::make_unique<Model>(like);
  }

  /// Shares a model, and keeps it when nobody uses it any more. Any thread may be the last one: nothing is freed there.
  std::shared_ptr<const Model> share(std::unique_ptr<Model> model) const {
    return std::shared_ptr<Model>(model.release(), [shelf = shelf_](Model* unused) {
      std::unique_ptr<Model> kept(unused);
      const std::lock_guard lock(shelf->mutex);
      if (shelf->model == nullptr) kept.swap(shelf->model);
    });
  }

 private:
  struct Shelf {
    std::mutex mutex;
    std::unique_ptr<Model> model;
  };
  std::shared_ptr<Shelf> shelf_ = std::make_shared<Shelf>();
};

}  // namespace tensormass::model
